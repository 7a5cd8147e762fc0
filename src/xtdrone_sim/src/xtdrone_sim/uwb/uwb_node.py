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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import rospy
from xtdrone_msgs.msg import RelativeRange, RelativeRanges, SceneState

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import Vehicle
from xtdrone_common.poses import Pose, compose
from xtdrone_common.settings import Settings
from xtdrone_sim.rays.live_rays import scene_of
from xtdrone_sim.rays.scene import SceneAt
from xtdrone_sim.sensors.ranging_node import RangingNode, Station, run_ranging_node
from xtdrone_sim.sensors.sensor_nodes import Due, rate_setting, time_us
from xtdrone_sim.uwb.line_of_sight import Moment, Sights
from xtdrone_sim.uwb.ranging import Neighbours, find_neighbours, measure_ranges, neighbours_of
from xtdrone_sim.vehicles.mounts.body_sensors import LEAST_RATE, MOST_RATE, SIGHT_IGNORED
from xtdrone_sim.vehicles.mounts.fleet_sensor import Antenna, antennas_of

USAGE = "uwb.py"

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
class _Station(Station):
    """A sensor with its neighbours.

    Attributes:
        first: neighbours at the sensor's start, whose places in the measurement are kept even if they leave.
        joined: neighbours that have joined since.
    """

    first: tuple[Antenna, ...] = ()
    joined: tuple[Antenna, ...] = ()

    @property
    def others(self) -> tuple[Antenna, ...]:
        """All neighbours, including those that have left."""
        return (*self.first, *self.joined)


class UwbNode(RangingNode[_Station]):
    """Measures and publishes ranges, turn by turn."""

    name = "uwb"
    kind = "UWB sensor"
    find = staticmethod(antennas_of)

    def __init__(self, fleet: Sequence[Vehicle], settings: UwbSettings) -> None:
        """Advertise topics and services; see ``RangingNode``."""
        self._settings = settings
        self._scenes: list[tuple[int, SceneAt]] = []  # the last two, with their times in microseconds
        super().__init__(fleet)

    def _serve(self, sensors: Sequence[Antenna], *, joins: bool) -> None:
        new = []
        for antenna in sensors:
            rate = self._settings.rate or antenna.mount.rate
            one = replace(antenna, mount=replace(antenna.mount, rate=rate))
            self._failures.add(one.topic)
            new.append(_Station(one, lockstep.Publisher(one.topic, RelativeRanges), Due(rate), joins))
        self._stations += new
        there = [station.sensor for station in self._stations]
        for k, sensor in enumerate(self._stations):
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

    def _leave(self, vehicle: Vehicle) -> None:
        super()._leave(vehicle)
        for station in self._stations:
            station.joined = tuple(other for other in station.joined if other.vehicle != vehicle.name)

    def _take_scene(self, message: SceneState) -> None:
        now_us = message.header.stamp.to_nsec() // 1000
        if not self._scenes or now_us > self._scenes[-1][0]:
            self._scenes = [*self._scenes[-1:], (now_us, scene_of(message))]

    def _restart(self) -> None:
        self._scenes.clear()
        super()._restart()

    def _first_us(self, station: _Station) -> int | None:
        link = station.sensor.link
        return next((time for time, scene in self._scenes if not station.joins or link in scene.links), None)

    def step(self) -> None:
        """Publish the measurements between the last two scenes."""
        due: dict[int, list[_Station]] = {}
        for station, number in self._due(self._scenes[-1][0] if self._scenes else 0):
            due.setdefault(time_us(station.sensor.mount.rate, number), []).append(station)
        for now_us, stations in sorted(due.items(), key=lambda item: item[0]):
            self._measure(now_us, stations)

    def _measure(self, now_us: int, stations: Sequence[_Station]) -> None:
        """Publish the sensors' measurements at one time."""
        (first_us, before), (last_us, after) = self._scenes[0], self._scenes[-1]
        moment = Moment(before, after, (now_us - first_us) / (last_us - first_us) if last_us > first_us else 0.0)
        poses = {one.sensor.topic: _place(moment.pose(one.sensor.link), one.sensor) for one in self._stations}
        heard = {topic: pose.position for topic, pose in poses.items() if pose and self._failures[topic].kind != "off"}
        sights: Sights | None = None
        for station in stations:
            pose, mount = poses[station.sensor.topic], station.sensor.mount
            if pose is None:
                rospy.logwarn_throttle(10.0, f"/xtdrone/scene has no {station.sensor.link}: no ranges")
                continue
            places = [heard.get(other.topic, _NOWHERE) for other in station.others]
            positions = np.array(places).reshape(-1, 3)
            true = find_neighbours(pose, positions, mount.range_max)
            if mount.line_of_sight != SIGHT_IGNORED and true.heard.any():
                rays = self._rays.scene()
                if rays is None:
                    continue
                sights = sights or Sights(rays, moment)
                _look(station, sights, np.array(pose.position), positions, true)
            self._publish(station, now_us, true)

    def _publish(self, station: _Station, now_us: int, true: Neighbours) -> None:
        antenna, failure = station.sensor, self._failure(station)
        if failure.kind != "frozen" or station.last is None:
            number = round(now_us * 1e-6 * antenna.mount.rate)
            joined = [other.vehicle for other in station.joined]
            seen = measure_ranges(antenna.mount, antenna.vehicle, number, true, failure.bias, failure.dropouts, joined)
            station.last = _Measured(station.others, seen)
        station.publisher.publish(ranges_message(antenna, station.last.others, now_us, station.last.seen))


def _look(station: _Station, sights: Sights, position: np.ndarray, positions: np.ndarray, true: Neighbours) -> None:
    """Set ``blocked`` for the neighbours without line of sight."""
    heard = np.flatnonzero(true.heard)
    names = [station.others[other].vehicle for other in heard]
    true.blocked[heard] = sights.blocked(station.sensor.vehicle, position, names, positions[heard])


def _place(body: Pose | None, antenna: Antenna) -> Pose | None:
    return None if body is None else compose(body, antenna.mount.pose)


def ranges_message(sensor: Antenna, others: Sequence[Antenna], time_us: int, seen: Neighbours) -> RelativeRanges:
    """Return the message of a measurement.

    Args:
        sensor: the measuring sensor.
        others: its n neighbours.
        time_us: simulated time of the measurement, microseconds.
        seen: the measurement.
    """
    message = RelativeRanges(vehicle=sensor.vehicle)
    message.header.stamp, message.header.frame_id = rospy.Time(0, time_us * 1000), sensor.frame_id
    deviations = seen.deviations(sensor.mount)
    for k, other in enumerate(others):
        if not seen.heard[k]:
            continue
        one = RelativeRange(vehicle=other.vehicle, frame_id=other.frame_id, line_of_sight=not seen.blocked[k])
        one.range, one.range_std = float(seen.ranges[k]), float(deviations[k])
        if sensor.mount.bearing:
            one.has_bearing, one.bearing_std = True, sensor.mount.bearing_noise
            one.azimuth, one.elevation = float(seen.azimuths[k]), float(seen.elevations[k])
        message.ranges.append(one)
    return message


def main(arguments: Sequence[str]) -> None:
    """Serve all UWB sensors of the fleet until shutdown.

    Raises:
        ArgumentError: an argument or parameter is not allowed.
    """
    run_ranging_node(UwbNode, UwbSettings, "iris_uwb:2", arguments)
