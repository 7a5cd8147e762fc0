"""Director of a flight through obstacles; a lockstep node.

For every vehicle T of /xtdrone/fleet:

========================================  =======================  ====================================================
subscribed
/T/mavros/state                           mavros_msgs/State
/T/mavros/local_position/pose             PoseStamped              for the progress
/T/planner/state                          String                   or exploration/state, see ``TASKS``
published
/T/planner/goal                           PoseStamped              or exploration/start
/xtdrone/demo/events                      String (JSON)            event, time (simulated s), ...
/xtdrone/demo/progress                    String (JSON)            phase, vehicles under way, shortest remaining
distance ========================================  =======================
====================================================

It arms, takes off and lands through MAVROS's services.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import rospy
from geometry_msgs.msg import PoseStamped
from mavros_msgs.msg import State
from std_msgs.msg import String

from xtdrone_control import lockstep
from xtdrone_control.communication.commands import CommandRequest
from xtdrone_control.communication.multirotor import MavrosServices
from xtdrone_interaction.crossing.crossing_mission import TASKS, Crossing, CrossingSettings
from xtdrone_interaction.formation.flight_events import EVENTS_FILE, EventsFile
from xtdrone_interaction.formation.shared_topics_and_names import EVENTS_TOPIC, PROGRESS_TOPIC

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
        self._events = EventsFile(Path(settings.out) / EVENTS_FILE, rospy.logwarn) if settings.out else None
        self._event_publisher = lockstep.Publisher(EVENTS_TOPIC, String)
        self._progress_publisher = lockstep.Publisher(PROGRESS_TOPIC, String)
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

    def wait_for_recorder(self, node: str, timeout: float) -> bool:
        """Wait up to ``timeout`` s of wall time until a node has subscribed to the events; return whether it has."""
        return self._event_publisher.wait_for_subscriber(node, timeout)

    def run(self) -> int:
        """Fly; return 0 if all vehicles have arrived, else 1."""
        rate = lockstep.Rate()
        self._event("start", vehicles=[crossing.name for crossing in self._crossings])
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
        self._event("finished", failed=[crossing.name for crossing in failed])
        for _ in range(_LAST_TICKS):
            self._publish_progress()
            rate.sleep()
        return 1 if failed else 0

    def close(self) -> None:
        """Close file and services."""
        if self._events is not None:
            self._events.close()
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
            self._event(
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

    def _event(self, event: str, **values: Any) -> None:
        """Publish an event, and append it, with the wall time (which no topic may contain), to the events file."""
        numbers = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()}
        values = {"event": event, "time": rospy.get_time(), **numbers}
        self._event_publisher.publish(String(json.dumps(values)))
        if self._events is not None:
            self._events.write(json.dumps({**values, "wall": time.monotonic()}) + "\n")

    def _publish_progress(self) -> None:
        left = [
            math.dist(self._positions[crossing.name], crossing.goal)
            for crossing in self._crossings
            if crossing.name in self._positions and not crossing.is_over
        ]
        phase = min((crossing.phase for crossing in self._crossings), key=_PHASES.index)
        values = {
            "sim_time": rospy.get_time(),
            "phase": phase,
            "step": _PHASES.index(phase) + 1,
            "steps": len(_PHASES),
            "text": f"{max(left):.0f} m to the goal" if left else "",
        }
        self._progress_publisher.publish(String(json.dumps(values)))
