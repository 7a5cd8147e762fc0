"""The formation director, a lockstep node that flies a formation mission.

Topics, for every vehicle T of /xtdrone/fleet:

========================================  =======================  ====================================================
subscribed
/T/mavros/state                           mavros_msgs/State
/T/mavros/local_position/pose             PoseStamped              position without ground truth
/gazebo/model_states                      ModelStates              ground truth
/xtdrone/formation_pattern                Float32MultiArray        assigned offsets
/xtdrone/T/cmd_{vel,accel}_enu            Twist                    shows that T's follower is running
published
/xtdrone/T/cmd                            String                   ARM, OFFBOARD, AUTO.LAND, ...
/xtdrone/leader/cmd                       String                   names of patterns
/xtdrone/leader/cmd_vel_flu               Twist
/xtdrone/demo/events                      String (JSON)            event, time (simulated s), ...
/xtdrone/demo/progress                    String (JSON)            phase, step, sim_time, error, distance, ...
========================================  =======================  ====================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import rospy
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import PoseStamped, Twist
from mavros_msgs.msg import State
from std_msgs.msg import Float32MultiArray, String

import xtdrone_lockstep as lockstep
from xtdrone_common.rotation import yaw_of
from xtdrone_common.settings import Settings, setting
from xtdrone_interaction.command_options import split_patterns, swarm_patterns
from xtdrone_interaction.missions.director import RECORDER_LIMIT, FlightReporter
from xtdrone_interaction.missions.formation.state_machine import FleetState, FormationMission, MissionError
from xtdrone_interaction.recording.distances import Array, least_distances, offsets_from_message
from xtdrone_interaction.recording.topics import (
    ESTIMATE,
    PATTERN_TOPIC,
    TRUTH,
    TRUTH_TOPIC,
)

RATE = 30.0  # Hz
_PROGRESS_TICKS = 6  # 5 Hz of simulated time
_REPEATED = 2.0  # s between two messages of a leader that repeats its pattern
_LAST_TICKS = 15  # ticks to run after the flight, so that the recorder receives the last events


@dataclass(frozen=True)
class DirectorSettings(Settings):
    """Private parameters of the node, besides ``~patterns``."""

    pattern_file: str = setting("", text="YAML file with your own patterns, empty for none")
    clearance: float = setting(3.0, low=0.0, unit="m", text="minimum height of any slot above the ground")
    out: str = setting("", text="folder for events.jsonl, empty for none")
    recorder: str = setting(
        "", text=f"node that records the flight; time starts when it has subscribed, or after {RECORDER_LIMIT:g} s"
    )


class FormationDirector:
    """Feeds the mission's view from topics and sends its commands."""

    ends_launch = False

    def __init__(
        self,
        names: Sequence[str],
        patterns: Sequence[str],
        slots: Mapping[str, Array],
        clearance: float,
        out: str = "",
        recorder: str = "",
    ) -> None:
        """Declare the topics.

        Args:
            names: Names of the vehicles, the leader first.
            patterns: Patterns flown in turn.
            slots: Offsets of each pattern and of ``origin``, shape (n - 1, 3), m.
            clearance: Minimum height of any slot above the ground, m.
            out: Folder of events.jsonl; "" for none.
            recorder: Node that records the flight; "" for none.

        Raises:
            OSError: the events file cannot be written.
        """
        self.view = FleetState(names)
        self.mission = FormationMission(self.view, self, patterns, slots, clearance)
        self.recorder = recorder
        self.reporter = FlightReporter(out)
        self._has_truth = False
        self._pattern_said = -math.inf
        self._least_distance = math.inf
        self._commands = [lockstep.Publisher(f"/xtdrone/{name}/cmd", String) for name in names]
        self._leader_command = lockstep.Publisher("/xtdrone/leader/cmd", String)
        self._leader_velocity = lockstep.Publisher("/xtdrone/leader/cmd_vel_flu", Twist)
        self._subscriptions = [
            lockstep.Subscriber(TRUTH_TOPIC, ModelStates, self._on_truth),
            lockstep.Subscriber(PATTERN_TOPIC, Float32MultiArray, self._on_offsets),
        ]
        for i, name in enumerate(names):
            self._subscriptions += [
                lockstep.Subscriber(f"/{name}/mavros/state", State, self._on_state, i),
                lockstep.Subscriber(f"/{name}/mavros/local_position/pose", PoseStamped, self._on_pose, i),
            ]
        for i, name in list(enumerate(names))[1:]:
            self._subscriptions += [
                lockstep.Subscriber(f"/xtdrone/{name}/cmd_{kind}_enu", Twist, self._on_command, i)
                for kind in ("vel", "accel")
            ]

    def close(self) -> None:
        """Close the events file."""
        self.reporter.close()

    # subscriptions

    def _on_state(self, message: State, index: int) -> None:
        self.view.connected[index] = message.connected
        self.view.armed[index] = message.armed
        self.view.mode[index] = message.mode

    def _on_pose(self, message: PoseStamped, index: int) -> None:
        if not self._has_truth:
            self._place(index, message.pose)

    def _on_truth(self, message: ModelStates) -> None:
        places = dict(zip(message.name, message.pose, strict=False))
        if all(name in places for name in self.view.names):
            self._has_truth = True
            for index, name in enumerate(self.view.names):
                self._place(index, places[name])

    def _place(self, index: int, pose: Any) -> None:
        self.view.position[index] = (pose.position.x, pose.position.y, pose.position.z)
        if index == 0:
            q = pose.orientation
            self.view.leader_yaw = yaw_of((q.w, q.x, q.y, q.z))

    def _on_offsets(self, message: Float32MultiArray) -> None:
        size = 3 * (len(self.view.names) - 1)
        if len(message.data) not in (0, size) or not all(map(math.isfinite, message.data)):
            rospy.logwarn_once(
                f"director: {PATTERN_TOPIC}: {len(message.data)} values that are not {size} finite numbers; ignored"
            )
            return
        self.view.offsets = offsets_from_message(message.data)
        before, self._pattern_said = self._pattern_said, rospy.get_time()
        if self._pattern_said - before <= _REPEATED:  # a leader that publishes each pattern only once never times out
            self.view.pattern_time = self._pattern_said

    def _on_command(self, _: Twist, index: int) -> None:
        self.view.commanded[index] = rospy.get_time()

    # publications; the mission's Commands

    def vehicle(self, index: int, command: str) -> None:
        """Send an XTDrone command to one vehicle's communication node."""
        self._commands[index].publish(String(command))

    def leader(self, command: str) -> None:
        """Send a command to the leader node."""
        self._leader_command.publish(String(command))

    def leader_velocity(self, velocity: Array) -> None:
        """Send a velocity, shape (3,), m/s FLU, to the leader node."""
        message = Twist()
        message.linear.x, message.linear.y, message.linear.z = map(float, velocity)
        self._leader_velocity.publish(message)

    def event(self, event: str, **values: Any) -> None:
        """Publish, store and log an event."""
        text = self.reporter.event(event, **{"time": self.view.time, **values})
        {"failed": rospy.logerr, "lost": rospy.logwarn}.get(event, rospy.loginfo)("director: %s", text)

    # the flight

    def run(self) -> int:
        """Fly; return the exit status: 0 for a complete flight, 1 for one that failed or has lost vehicles."""
        rate = lockstep.Rate()
        self.view.time = rospy.get_time()
        self.event("start", vehicles=list(self.view.names), patterns=self.mission.patterns)
        try:
            self._advance(self.mission.fly(), rate)
        except MissionError as error:
            self._give_up(str(error), rate)
            return 1
        if rospy.is_shutdown():
            self.event("interrupted")
            return 1
        self.event("done", **self.mission.result)
        self._stay(rate)
        return 1 if self.mission.lost else 0

    def _advance(self, ticks: Any, rate: Any) -> None:
        """Advance ``ticks`` once per tick until it ends or the node is shut down.

        Raises:
            MissionError: the mission has failed, or simulated time has jumped back.
        """
        for number, _ in enumerate(ticks):
            if number % _PROGRESS_TICKS == 0:
                self._publish_progress()
            rate.sleep()
            before, self.view.time = self.view.time, rospy.get_time()
            if rospy.is_shutdown():
                return
            if self.view.time < before:
                raise MissionError(f"the simulation was set back from {before:.1f} s to {self.view.time:.1f} s")

    def _give_up(self, reason: str, rate: Any) -> None:
        """Land all vehicles; the flight has failed for ``reason``."""
        self.event("giving up", reason=reason)
        self.mission.phase = "landing after a failure"
        try:
            self._advance(self.mission.land(), rate)
        except MissionError as error:
            rospy.logerr("director: %s", error)
        self.event("failed", reason=reason)
        self._stay(rate)

    def _stay(self, rate: Any) -> None:
        """Run for a few more ticks, so that subscribers receive the last messages."""
        for _ in range(_LAST_TICKS):
            self._publish_progress()
            rate.sleep()
            if rospy.is_shutdown():
                return

    def _publish_progress(self) -> None:
        """Publish the progress; times in s, distances in m, error is the greatest of all followers."""
        error = self.mission.error()
        distance = float(least_distances(self.view.position[None])[0])
        if self.mission.step > 1 and math.isfinite(distance):
            self._least_distance = min(self._least_distance, distance)
        self.reporter.progress(
            self.mission.phase,
            self.mission.step,
            self.mission.steps,
            sim_time=self.view.time,
            error=_finite(error.max() if error is not None else math.nan),
            distance=_finite(distance),
            least_distance=_finite(self._least_distance),
            positions=TRUTH if self._has_truth else ESTIMATE,
        )


def _finite(value: float) -> float | None:
    """Return ``value``, or None for NaN and infinity, which JSON lacks."""
    return float(value) if math.isfinite(value) else None


def make_director(names: Sequence[str]) -> FormationDirector:
    """Return the director that the parameters of the node ask for.

    Raises:
        KeyError, ValueError, OSError: a parameter is missing or not allowed.
    """
    patterns = split_patterns(str(rospy.get_param("~patterns", "cube,pyramid,triangle")))
    settings = DirectorSettings.from_parameters(rospy.get_param)
    slots = swarm_patterns(len(names), patterns, settings.pattern_file or None)
    return FormationDirector(names, patterns, slots, settings.clearance, settings.out, settings.recorder)
