"""The UWB sensors of all vehicles as a ROS node.

=================================  ============================  =====================================================
topic or service                   type                          content
=================================  ============================  =====================================================
/T/NAME                            xtdrone_msgs/RelativeRanges   ranges, and bearings, to the other vehicles
/T/NAME/failure                    xtdrone_msgs/SetLidarFailure  lets the sensor fail
/xtdrone/scene (subscribed)        xtdrone_msgs/SceneState       poses of links and actors
/xtdrone/models (subscribed)       xtdrone_msgs/SceneModels      models added and deleted since the start
=================================  ============================  =====================================================

T is a vehicle, e.g. ``iris_uwb_0``, NAME the name of its sensor, e.g. ``uwb``.

Measurement k of a sensor is at k / rate s, between two scenes, and is published in the turn of the second one. Sensors
without subscribers measure nothing; one that is off does not answer others either.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import rospy
from xtdrone_msgs.msg import RelativeRanges, SceneModels, SceneState

from xtdrone_control import lockstep
from xtdrone_control.fleet import Vehicle
from xtdrone_control.programs.program import ArgumentError, check_no_arguments, fleet_of
from xtdrone_control.settings import Settings
from xtdrone_sim.early_parameters import private_parameters
from xtdrone_sim.sensors.measurement_times import Due, rate_setting, time_us
from xtdrone_sim.shapes.pose_arithmetic import compose
from xtdrone_sim.shapes.visual import Pose
from xtdrone_sim.topics.failure_services import FailureServices
from xtdrone_sim.topics.live_rays import LiveRays
from xtdrone_sim.topics.scene_messages import scene_of
from xtdrone_sim.uwb.antennas import Antenna, antennas_of, neighbours_of
from xtdrone_sim.uwb.line_of_sight import Moment, Sights
from xtdrone_sim.uwb.ranging import Neighbours, measured, seen_from
from xtdrone_sim.uwb.uwb_messages import ranges_message
from xtdrone_sim.vehicles.mounts.uwb_mounts import LEAST_RATE, MOST_RATE, SIGHT_IGNORED
from xtdrone_sim.worlds.scene_at import SceneAt

USAGE = "uwb.py"
TURNS = 50.0  # Hz, rate of /xtdrone/scene

_NAME = "uwb"


@dataclass(frozen=True)
class UwbSettings(Settings):
    """Private parameters of the node."""

    rate: float = rate_setting(
        LEAST_RATE, MOST_RATE, "measurements per second of each UWB sensor, 0 for the rate in its vehicle's file"
    )


@dataclass
class _State:
    """State of a sensor: its measurements that are due, and the latest one."""

    due: Due
    last: Neighbours | None = None


class UwbNode:
    """Measures and publishes ranges, turn by turn."""

    def __init__(self, antennas: Sequence[Antenna], settings: UwbSettings) -> None:
        """Advertise topics and services.

        Args:
            antennas: all UWB sensors of the fleet, vehicle by vehicle.
            settings: see ``UwbSettings``.
        """
        self._antennas = [
            replace(antenna, mount=replace(antenna.mount, rate=settings.rate or antenna.mount.rate))
            for antenna in antennas
        ]
        self._neighbours = [neighbours_of(k, self._antennas) for k in range(len(self._antennas))]
        self._publishers = [lockstep.Publisher(antenna.topic, RelativeRanges) for antenna in self._antennas]
        self._states = [_State(Due(antenna.mount.rate)) for antenna in self._antennas]
        self._failures = FailureServices([antenna.topic for antenna in self._antennas])
        self._rays = LiveRays(_NAME)
        self._scenes: list[tuple[int, SceneAt]] = []  # the last two, with their times in microseconds
        lockstep.Subscriber("/xtdrone/scene", SceneState, self._take_scene)
        lockstep.Subscriber("/xtdrone/models", SceneModels, self._rays.change)
        lockstep.add_reset_hook(self._restart)

    def begin(self, world: str, fleet: Sequence[Vehicle]) -> None:
        """Start measuring.

        Args:
            world: name or file.
            fleet: all vehicles, which stand between others.
        """
        self._rays.begin(world, fleet)

    def _take_scene(self, message: SceneState) -> None:
        now_us = message.header.stamp.to_nsec() // 1000
        if not self._scenes or now_us > self._scenes[-1][0]:
            self._scenes = [*self._scenes[-1:], (now_us, scene_of(message))]

    def _restart(self) -> None:
        """Discard the state from before a reset of simulated time, except failures."""
        self._scenes.clear()
        for state in self._states:
            state.due.restart()
            state.last = None

    def step(self) -> None:
        """Publish the measurements between the last two scenes."""
        if not self._scenes:
            return
        due: dict[int, list[int]] = {}
        for k in range(len(self._antennas)):
            for number in self._states[k].due.numbers(self._scenes[0][0], self._scenes[-1][0]):
                if self._publishers[k].get_num_connections() and self._failures[k].kind != "off":
                    due.setdefault(time_us(self._antennas[k].mount.rate, number), []).append(k)
        for now_us, sensors in sorted(due.items()):
            self._measure(now_us, sensors)

    def _measure(self, now_us: int, sensors: Sequence[int]) -> None:
        """Publish what sensors measure at one time."""
        (first_us, before), (last_us, after) = self._scenes[0], self._scenes[-1]
        moment = Moment(before, after, (now_us - first_us) / (last_us - first_us) if last_us > first_us else 0.0)
        bodies = {antenna.link: moment.pose(antenna.link) for antenna in self._antennas}
        poses = [_placed(bodies[antenna.link], antenna) for antenna in self._antennas]
        positions = np.array([pose.position if pose else (np.nan,) * 3 for pose in poses])
        positions[[self._failures[k].kind == "off" for k in range(len(self._antennas))]] = np.nan
        sights: Sights | None = None
        for k in sensors:
            pose, others = poses[k], list(self._neighbours[k])
            if pose is None:
                rospy.logwarn_throttle(10.0, f"/xtdrone/scene does not have {self._antennas[k].link}: no ranges")
                continue
            true = seen_from(pose, positions[others], self._antennas[k].mount.range_max)
            if self._antennas[k].mount.line_of_sight != SIGHT_IGNORED and true.heard.any():
                rays = self._rays.scene()
                if rays is None:
                    continue
                sights = sights or Sights(rays, moment)
                self._look(k, sights, positions, true)
            self._publish(k, now_us, true)

    def _look(self, k: int, sights: Sights, positions: np.ndarray, true: Neighbours) -> None:
        """Fill in which neighbours have no line of sight."""
        heard = np.flatnonzero(true.heard)
        others = np.array(self._neighbours[k])[heard]
        names = [self._antennas[other].vehicle for other in others]
        true.blocked[heard] = sights.blocked(self._antennas[k].vehicle, positions[k], names, positions[others])

    def _publish(self, k: int, now_us: int, true: Neighbours) -> None:
        antenna, state, failure = self._antennas[k], self._states[k], self._failures[k]
        if failure.kind != "frozen" or state.last is None:
            number = round(now_us * 1e-6 * antenna.mount.rate)
            state.last = measured(antenna.mount, antenna.vehicle, number, true, failure.bias, failure.dropouts)
        others = [self._antennas[other] for other in self._neighbours[k]]
        self._publishers[k].publish(ranges_message(antenna, others, now_us, state.last))

    def close(self) -> None:
        """End the services."""
        self._failures.close()


def _placed(body: Pose | None, antenna: Antenna) -> Pose | None:
    return None if body is None else compose(body, antenna.mount.pose)


def main(arguments: Sequence[str]) -> None:
    """Serve all UWB sensors of the fleet until shutdown.

    Raises:
        ArgumentError: an argument or parameter is not allowed.
    """
    check_no_arguments(arguments)
    parameters: dict[str, Any] = private_parameters(_NAME, sys.argv)
    text = str(parameters.get("fleet") or rospy.get_param("/xtdrone/fleet", "iris_uwb:2"))
    fleet = fleet_of(text) or ()
    try:
        settings = UwbSettings.from_parameters(lambda name, default: parameters.get(name[1:], default))
        antennas = antennas_of(fleet)
    except ValueError as error:
        raise ArgumentError(str(error)) from error
    if not antennas:
        raise ArgumentError(f"/xtdrone/fleet: no vehicle of {text!r} has a UWB sensor")
    lockstep.init_node(_NAME, rate=TURNS)
    node = UwbNode(antennas, settings)
    try:
        lockstep.start()  # returns when the simulator is running and has set the world
        node.begin(str(rospy.get_param("~world", rospy.get_param("/xtdrone/world", "empty"))), fleet)
        lockstep.spin(node.step)
    finally:
        node.close()
