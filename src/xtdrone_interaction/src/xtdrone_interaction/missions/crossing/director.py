"""Directors of a flight through obstacles, alone or in formation; a lockstep node.

For every vehicle T of /xtdrone/fleet:

========================================  =======================  ====================================================
subscribed
/T/mavros/state                           mavros_msgs/State
/T/mavros/local_position/pose             PoseStamped              for the progress
/T/planner/state                          String                   or exploration/state, see ``TASKS``
published
/T/planner/goal                           PoseStamped              or exploration/start
/xtdrone/demo/events                      String (JSON)            event, time (simulated s), ...
/xtdrone/demo/progress                    String (JSON)            phase, distance to the goal
========================================  =======================  ====================================================

A formation has also:

========================================  =======================  ====================================================
subscribed
/xtdrone/formation_pattern                Float32MultiArray        slots that the leader has assigned
published
/xtdrone/leader/cmd                       String                   name of the pattern
/T/planner/goal                           PoseStamped              the leader's goal; each follower's first slot
========================================  =======================  ====================================================

It arms, takes off and lands through MAVROS's services.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import rospy
import yaml
from geometry_msgs.msg import PoseStamped
from mavros_msgs.msg import State
from std_msgs.msg import Float32MultiArray, String

import xtdrone_lockstep as lockstep
from xtdrone_control.communication.commands import CommandRequest
from xtdrone_control.communication.multirotor import MavrosServices
from xtdrone_interaction.missions.crossing.state_machine import (
    STAGES,
    TASKS,
    Crossing,
    CrossingSettings,
    FormationCrossing,
    Member,
)
from xtdrone_interaction.missions.director import FlightReporter
from xtdrone_interaction.recording.distances import Array, formation_error, least_distances, offsets_from_message
from xtdrone_interaction.recording.topics import PATTERN_TOPIC

RATE = 10.0  # Hz
_PROGRESS_TICKS = 2
_PHASES = ("preparing", "taking off", "crossing", "landing", "landed", "failed")
_LAST_TICKS = 5  # ticks to run after the flight, so that the recorder receives the last events

Goal = tuple[float, float, float]


class GoalsError(ValueError):
    """Goals that are not allowed; the message names the parameter, its value and what is allowed."""


def parse_goals(value: object, names: Sequence[str]) -> dict[str, Goal]:
    """Return each vehicle's goal from a list of [x, y, z], m in map, one per vehicle.

    Raises:
        GoalsError: wrong number of goals, or one that is not three finite numbers.
    """
    if not isinstance(value, list) or len(value) != len(names):
        raise GoalsError(f"goals: {value!r} is not allowed, a list of {len(names)} goals [x, y, z]")
    goals = {}
    for name, goal in zip(names, value, strict=True):
        numbers = isinstance(goal, list) and len(goal) == 3 and all(type(part) in (int, float) for part in goal)
        if not numbers or not all(map(math.isfinite, goal)):
            raise GoalsError(f"goals: {goal!r} of {name} is not allowed, three numbers [x, y, z], m")
        goals[name] = (float(goal[0]), float(goal[1]), float(goal[2]))
    return goals


class CrossingDirector:
    """Flies each vehicle to its goal."""

    ends_launch = True

    def __init__(self, goals: Mapping[str, Goal], settings: CrossingSettings) -> None:
        """Declare the topics.

        Args:
            goals: by vehicle, m in map.
            settings: see ``CrossingSettings``.

        Raises:
            OSError: the events file cannot be written.
        """
        self._crossings = self._crossings_to(goals, settings)
        self._positions: dict[str, Goal] = {}
        self.recorder = settings.recorder
        self.reporter = FlightReporter(settings.out)
        self._goals: dict[str, lockstep.Publisher] = {}
        self._services: dict[str, MavrosServices] = {}
        for crossing in self._crossings:
            self._declare(crossing)

    def _crossings_to(self, goals: Mapping[str, Goal], settings: CrossingSettings) -> Sequence[Crossing]:
        """Return the flight of each vehicle."""
        task = TASKS[settings.task]
        return [Crossing(name, goal, settings.time_limit, task) for name, goal in goals.items()]

    def _declare(self, crossing: Crossing) -> None:
        name, reports = crossing.name, crossing.reports
        self._goals[name] = lockstep.Publisher(f"/{name}/{crossing.task.goal}", PoseStamped)
        self._services[name] = MavrosServices(name, in_lockstep=lockstep.is_active())

        def on_state(message: State) -> None:
            reports.armed, reports.mode = message.armed, message.mode

        def on_planner(message: String) -> None:
            reports.planner = message.data

        def on_pose(message: PoseStamped) -> None:
            place = message.pose.position
            self._positions[name] = (place.x, place.y, place.z)

        lockstep.Subscriber(f"/{name}/mavros/state", State, on_state)
        lockstep.Subscriber(f"/{name}/{crossing.task.state}", String, on_planner)
        lockstep.Subscriber(f"/{name}/mavros/local_position/pose", PoseStamped, on_pose)

    def run(self) -> int:
        """Fly; return 0 if all vehicles have arrived, else 1."""
        rate = lockstep.Rate()
        self.reporter.event("start", vehicles=[crossing.name for crossing in self._crossings])
        tick = 0
        while not rospy.is_shutdown() and not all(crossing.is_over for crossing in self._crossings):
            for crossing in self._crossings:
                self._advance(crossing)
            self._advance_together()
            if tick % _PROGRESS_TICKS == 0:
                self._publish_progress()
            tick += 1
            rate.sleep()
        failed = [crossing for crossing in self._crossings if crossing.outcome != "arrived"]
        self.reporter.event("finished", failed=[crossing.name for crossing in failed])
        for _ in range(_LAST_TICKS):
            self._publish_progress()
            rate.sleep()
        return 1 if failed else 0

    def close(self) -> None:
        """Close file and services."""
        self.reporter.close()
        for services in self._services.values():
            services.close()

    def _advance_together(self) -> None:
        """Hook for tasks of the whole group, called at the end of each turn; does nothing here."""

    def _advance(self, crossing: Crossing) -> None:
        phase = crossing.phase
        for command in crossing.step(rospy.get_time()):
            if command == "GOAL":
                self._send_goal(crossing, crossing.goal)
            else:
                self._services[crossing.name].submit(CommandRequest(command, True if command == "ARM" else None))
        for request, accepted, reason in self._services[crossing.name].finished():
            if not accepted:
                rospy.loginfo(f"{crossing.name}: {request.command} was rejected ({reason or 'not yet ready'})")
        if crossing.phase != phase:
            self.reporter.event(
                crossing.phase, vehicle=crossing.name, outcome=crossing.outcome, goal=list(crossing.goal),
                begun=crossing.begun, ended=crossing.ended,
            )  # fmt: skip

    def _send_goal(self, crossing: Crossing, goal: Goal) -> None:
        message = PoseStamped()
        message.header.stamp, message.header.frame_id = rospy.Time.now(), "map"
        place = message.pose.position
        place.x, place.y, place.z = goal
        message.pose.orientation.w = 1.0
        self._goals[crossing.name].publish(message)

    def _publish_progress(self) -> None:
        left = [
            math.dist(self._positions[crossing.name], crossing.goal)
            for crossing in self._crossings
            if crossing.name in self._positions and not crossing.is_over
        ]
        phase = min((crossing.phase for crossing in self._crossings), key=_PHASES.index)
        text = f"{max(left):.0f} m to the goal" if left else ""
        self.reporter.progress(phase, _PHASES.index(phase) + 1, len(_PHASES), text=text)


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
            self.reporter.event(
                "phase", phase=mission.stage, **({"pattern": self._pattern} if "pattern" in sent else {})
            )
        for what in sent:
            {"pattern": self._send_pattern, "slots": self._send_slots, "goal": self._send_leader}[what]()

    def _send_pattern(self) -> None:
        self._leader_command.publish(String(self._pattern))

    def _send_slots(self) -> None:
        """Send each follower its slot as a goal; from then on its velocity commands move this goal."""
        assert self._offsets is not None
        self.reporter.event("assigned", pattern=self._pattern, offsets=self._offsets.round(4).tolist())
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
        self.reporter.progress(
            stage,
            STAGES.index(stage) + 1,
            len(STAGES),
            error=None if errors is None else float(errors.max()),
            distance=None if places is None else float(least_distances(places[None])[0]),
        )


def make_director(names: Sequence[str]) -> CrossingDirector:
    """Return the director that the parameters of the node ask for.

    Raises:
        KeyError, ValueError, OSError, YAMLError: a parameter is missing or not allowed.
    """
    goals = rospy.get_param("~goals")
    settings = CrossingSettings.from_parameters(rospy.get_param)
    parsed = parse_goals(yaml.safe_load(goals) if isinstance(goals, str) else goals, names)
    return (FormationCrossingDirector if settings.pattern else CrossingDirector)(parsed, settings)
