"""The director of a formation's flight through obstacles, a lockstep node.

In addition to the topics of ``crossing_director``:

========================================  =======================  ====================================================
subscribed
/xtdrone/formation_pattern                Float32MultiArray        slots that the leader has assigned
published
/xtdrone/leader/cmd                       String                   name of the pattern
/T/planner/goal                           PoseStamped              the leader's goal; each follower's first slot
========================================  =======================  ====================================================
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence

import numpy as np
import rospy
from std_msgs.msg import Float32MultiArray, String

from xtdrone_control import lockstep
from xtdrone_interaction.crossing.crossing_director import CrossingDirector, Goal, GoalsError
from xtdrone_interaction.crossing.crossing_mission import TASKS, CrossingSettings
from xtdrone_interaction.crossing.formation_crossing import STAGES, FormationCrossing, Member
from xtdrone_interaction.formation.distances import Array, formation_error, least_distances, offsets_from_message
from xtdrone_interaction.formation.shared_topics_and_names import PATTERN_TOPIC


class FormationCrossingDirector(CrossingDirector):
    """Flies the first vehicle to its goal, and the others with it in formation."""

    def __init__(self, goals: Mapping[str, Goal], settings: CrossingSettings) -> None:
        """Declare the topics.

        Args:
            goals: by vehicle, m in map; only the first one's is used.
            settings: see ``CrossingSettings``.

        Raises:
            GoalsError: there is one vehicle only.
            OSError: the events file cannot be written.
        """
        if len(goals) < 2:
            raise GoalsError(f"pattern: {settings.pattern!r} is not allowed with {len(goals)} vehicle, 2 or more")
        super().__init__(goals, settings)
        self._pattern = settings.pattern
        self._offsets: Array | None = None
        self._leader_command = lockstep.Publisher("/xtdrone/leader/cmd", String)
        lockstep.Subscriber(PATTERN_TOPIC, Float32MultiArray, self._on_offsets)

    def _crossings_to(self, goals: Mapping[str, Goal], settings: CrossingSettings) -> Sequence[Member]:
        members = [Member(name, goal, settings.time_limit, TASKS[settings.task]) for name, goal in goals.items()]
        self._mission = FormationCrossing(members, settings.time_limit)
        return members

    def _on_offsets(self, message: Float32MultiArray) -> None:
        if len(message.data) == 3 * (len(self._crossings) - 1) and all(map(math.isfinite, message.data)):
            self._offsets = offsets_from_message(message.data)

    def _advance_together(self) -> None:
        mission, before = self._mission, self._mission.stage
        errors = self._errors()
        sent = mission.step(rospy.get_time(), None if errors is None else errors.tolist())
        if mission.stage != before:
            self._event("phase", phase=mission.stage, **({"pattern": self._pattern} if "pattern" in sent else {}))
        for what in sent:
            {"pattern": self._send_pattern, "slots": self._send_slots, "goal": self._send_leader}[what]()

    def _send_pattern(self) -> None:
        self._leader_command.publish(String(self._pattern))

    def _send_slots(self) -> None:
        """Send each follower its slot as a goal; from then on its velocity commands move this goal."""
        assert self._offsets is not None
        self._event("assigned", pattern=self._pattern, offsets=self._offsets.round(4).tolist())
        here = np.array(self._positions[self._crossings[0].name])
        for follower, place in zip(self._crossings[1:], (here + self._offsets).tolist(), strict=True):
            self._send_goal(follower, tuple(place))

    def _send_leader(self) -> None:
        leader = self._crossings[0]
        self._send_goal(leader, leader.goal)

    def _places(self) -> Array | None:
        """Return the vehicles' positions, shape (n, 3), m; None until all are known."""
        if any(crossing.name not in self._positions for crossing in self._crossings):
            return None
        return np.array([self._positions[crossing.name] for crossing in self._crossings])

    def _errors(self) -> Array | None:
        """Return the followers' distances from their slots, m; None until they are assigned."""
        places = self._places()
        return None if places is None or self._offsets is None else formation_error(places, self._offsets)

    def _publish_progress(self) -> None:
        errors, places, stage = self._errors(), self._places(), self._mission.stage
        values = {
            "sim_time": rospy.get_time(),
            "phase": stage,
            "step": STAGES.index(stage) + 1,
            "steps": len(STAGES),
            "error": None if errors is None else float(errors.max()),
            "distance": None if places is None else float(least_distances(places[None])[0]),
        }
        self._progress_publisher.publish(String(json.dumps(values)))
