"""The UWB sensors of all vehicles as a ROS node.

=================================  ============================  =====================================================
topic or service                   type                          content
=================================  ============================  =====================================================
/T/NAME                            xtdrone_msgs/RelativeRanges   ranges, and bearings, to the other vehicles
/T/NAME/failure                    xtdrone_msgs/SetLidarFailure  injects a failure of the sensor
/xtdrone/scene (subscribed)        xtdrone_msgs/SceneState       poses of links and actors
/xtdrone/models (subscribed)       xtdrone_msgs/SceneModels      models added and deleted since the start
/xtdrone/vehicles (subscribed)     std_msgs/String               vehicles that join and leave
=================================  ============================  =====================================================

T is a vehicle, e.g. ``iris_uwb_0``, NAME the name of its sensor, e.g. ``uwb``.

Measurement k of a sensor is at k / rate s, between two scenes, and is published in the turn of the second one. Sensors
without subscribers do not measure; one that is off does not respond to others either. A vehicle that joins measures and
is measured from its first scene on.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import rospy
from xtdrone_msgs.msg import RelativeRanges, SceneModels, SceneState

from xtdrone_control import lockstep
from xtdrone_control.fleet import Vehicle
from xtdrone_control.poses import Pose, compose
from xtdrone_control.programs.node_command_line import ArgumentError, check_no_arguments, fleet_of
from xtdrone_control.settings import Settings
from xtdrone_sim.rays.live_rays import LiveRays, scene_of
from xtdrone_sim.rays.scene import SceneAt
from xtdrone_sim.sensors.ranging_failures import FailureServices
from xtdrone_sim.sensors.sensor_nodes import Due, private_parameters, rate_setting, time_us
from xtdrone_sim.topics.fleet_changes import FleetChanges, vehicles_may_join
from xtdrone_sim.uwb.antennas import Antenna, antennas_of, neighbours_of
from xtdrone_sim.uwb.line_of_sight import Moment, Sights
from xtdrone_sim.uwb.ranging import Neighbours, measured, seen_from
from xtdrone_sim.uwb.uwb_messages import ranges_message
from xtdrone_sim.vehicles.mounts.body_sensors import LEAST_RATE, MOST_RATE, SIGHT_IGNORED

USAGE = "uwb.py"
TURNS = 50.0  # Hz, rate of /xtdrone/scene

_NAME = "uwb"
_NOWHERE = (math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class UwbSettings(Settings):
    """Private parameters of the node."""

    rate: float = rate_setting(
        LEAST_RATE, MOST_RATE, "measurements per second of each UWB sensor, 0 for the rate in its vehicle's file"
    )


class _Measured(NamedTuple):
    """A measurement and its neighbours."""

    others: tuple[Antenna, ...]
    seen: Neighbours


@dataclass(eq=False)
class _Sensor:
    """A sensor with its topic, its measurements that are due, the latest one, and its neighbours.

    Attributes:
        joins: whether its vehicle has joined in flight and has not been in a scene yet.
        first: neighbours at the sensor's start, whose places in the measurement are kept even if they leave.
        joined: neighbours that have joined since.
    """

    antenna: Antenna
    publisher: lockstep.Publisher
    due: Due
    joins: bool
    first: tuple[Antenna, ...] = ()
    joined: tuple[Antenna, ...] = ()
    last: _Measured | None = None

    @property
    def others(self) -> tuple[Antenna, ...]:
        """All neighbours, including those that have left."""
        return (*self.first, *self.joined)


class UwbNode:
    """Measures and publishes ranges, turn by turn."""

    def __init__(self, fleet: Sequence[Vehicle], settings: UwbSettings) -> None:
        """Advertise topics and services.

        Args:
            fleet: all vehicles, whose UWB sensors are served.
            settings: see ``UwbSettings``.

        Raises:
            ValueError: a vehicle type cannot be used.
        """
        self._settings = settings
        self._sensors: list[_Sensor] = []
        self._failures = FailureServices()
        self._rays = LiveRays(_NAME)
        self._scenes: list[tuple[int, SceneAt]] = []  # the last two, with their times in microseconds
        self._serve(antennas_of(fleet), joins=False)
        lockstep.Subscriber("/xtdrone/scene", SceneState, self._take_scene)
        lockstep.Subscriber("/xtdrone/models", SceneModels, self._rays.change)
        self._changes = FleetChanges(fleet, self._join, self._leave)
        lockstep.add_reset_hook(self._restart)

    def begin(self, world: str) -> None:
        """Start measuring in a world, given by name or file."""
        self._rays.begin(world, self._changes.fleet)

    def _serve(self, antennas: Sequence[Antenna], *, joins: bool) -> None:
        new = []
        for antenna in antennas:
            rate = self._settings.rate or antenna.mount.rate
            one = replace(antenna, mount=replace(antenna.mount, rate=rate))
            self._failures.add(one.topic)
            new.append(_Sensor(one, lockstep.Publisher(one.topic, RelativeRanges), Due(rate), joins))
        self._sensors += new
        there = [sensor.antenna for sensor in self._sensors]
        for k, sensor in enumerate(self._sensors):
            found = [there[other] for other in neighbours_of(k, there)]
            if sensor in new:
                sensor.first = tuple(found)
                continue
            known = {other.vehicle: place for place, other in enumerate(sensor.first)}
            first = list(sensor.first)
            for other in found:
                if other.vehicle in known:
                    first[known[other.vehicle]] = other  # the same, or another vehicle that has taken its name
            sensor.first = tuple(first)
            sensor.joined = tuple(other for other in found if other.vehicle not in known)

    def _join(self, vehicle: Vehicle) -> None:
        antennas = antennas_of([vehicle])
        self._rays.add_vehicle(vehicle)
        self._serve(antennas, joins=True)

    def _leave(self, vehicle: Vehicle) -> None:
        self._rays.remove_vehicle(vehicle)
        for sensor in [sensor for sensor in self._sensors if sensor.antenna.vehicle == vehicle.name]:
            self._sensors.remove(sensor)
            self._failures.remove(sensor.antenna.topic)
            sensor.publisher.unregister()
        for sensor in self._sensors:
            sensor.joined = tuple(other for other in sensor.joined if other.vehicle != vehicle.name)

    def _take_scene(self, message: SceneState) -> None:
        now_us = message.header.stamp.to_nsec() // 1000
        if not self._scenes or now_us > self._scenes[-1][0]:
            self._scenes = [*self._scenes[-1:], (now_us, scene_of(message))]

    def _restart(self) -> None:
        """Discard the state from before a reset of simulated time, except failures."""
        self._scenes.clear()
        for sensor in self._sensors:
            sensor.due.restart()
            sensor.last = None

    def step(self) -> None:
        """Publish the measurements between the last two scenes."""
        due: dict[int, list[_Sensor]] = {}
        for sensor in self._sensors:
            first_us = self._first_us(sensor)
            if first_us is None:
                continue
            sensor.joins = False
            for number in sensor.due.numbers(first_us, self._scenes[-1][0]):
                if sensor.publisher.get_num_connections() and self._failures[sensor.antenna.topic].kind != "off":
                    due.setdefault(time_us(sensor.antenna.mount.rate, number), []).append(sensor)
        for now_us, sensors in sorted(due.items(), key=lambda item: item[0]):
            self._measure(now_us, sensors)

    def _first_us(self, sensor: _Sensor) -> int | None:
        """Return the time of the first scene that a sensor can use, microseconds; None without one."""
        link = sensor.antenna.link
        return next((time for time, scene in self._scenes if not sensor.joins or link in scene.links), None)

    def _measure(self, now_us: int, sensors: Sequence[_Sensor]) -> None:
        """Publish the sensors' measurements at one time."""
        (first_us, before), (last_us, after) = self._scenes[0], self._scenes[-1]
        moment = Moment(before, after, (now_us - first_us) / (last_us - first_us) if last_us > first_us else 0.0)
        poses = {one.antenna.topic: _placed(moment.pose(one.antenna.link), one.antenna) for one in self._sensors}
        heard = {topic: pose.position for topic, pose in poses.items() if pose and self._failures[topic].kind != "off"}
        sights: Sights | None = None
        for sensor in sensors:
            pose, mount = poses[sensor.antenna.topic], sensor.antenna.mount
            if pose is None:
                rospy.logwarn_throttle(10.0, f"/xtdrone/scene has no {sensor.antenna.link}: no ranges")
                continue
            places = [heard.get(other.topic, _NOWHERE) for other in sensor.others]
            positions = np.array(places).reshape(-1, 3)
            true = seen_from(pose, positions, mount.range_max)
            if mount.line_of_sight != SIGHT_IGNORED and true.heard.any():
                rays = self._rays.scene()
                if rays is None:
                    continue
                sights = sights or Sights(rays, moment)
                _look(sensor, sights, np.array(pose.position), positions, true)
            self._publish(sensor, now_us, true)

    def _publish(self, sensor: _Sensor, now_us: int, true: Neighbours) -> None:
        antenna, failure = sensor.antenna, self._failures[sensor.antenna.topic]
        if failure.kind != "frozen" or sensor.last is None:
            number = round(now_us * 1e-6 * antenna.mount.rate)
            joined = [other.vehicle for other in sensor.joined]
            seen = measured(antenna.mount, antenna.vehicle, number, true, failure.bias, failure.dropouts, joined)
            sensor.last = _Measured(sensor.others, seen)
        sensor.publisher.publish(ranges_message(antenna, sensor.last.others, now_us, sensor.last.seen))

    def close(self) -> None:
        """End the services."""
        self._failures.close()


def _look(sensor: _Sensor, sights: Sights, position: np.ndarray, positions: np.ndarray, true: Neighbours) -> None:
    """Set ``blocked`` for the neighbours without line of sight."""
    heard = np.flatnonzero(true.heard)
    names = [sensor.others[other].vehicle for other in heard]
    true.blocked[heard] = sights.blocked(sensor.antenna.vehicle, position, names, positions[heard])


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
    if not antennas and not vehicles_may_join():
        raise ArgumentError(f"/xtdrone/fleet: no vehicle of {text!r} has a UWB sensor")
    lockstep.init_node(_NAME, rate=TURNS)
    node = UwbNode(fleet, settings)
    try:
        lockstep.start()  # returns when the simulator is running and has set the world
        node.begin(str(rospy.get_param("~world", rospy.get_param("/xtdrone/world", "empty"))))
        lockstep.spin(node.step)
    finally:
        node.close()
