"""The lidars of all vehicles as a ROS node.

=================================  ============================  ======================================================
topic or service                   type                          content
=================================  ============================  ======================================================
/T/NAME                            sensor_msgs/LaserScan         of lidars of kind scan; stamp: time of the first ray
/T/NAME                            sensor_msgs/PointCloud2       of others: x, y, z, intensity, ring, time
/T/NAME/failure                    xtdrone_msgs/SetLidarFailure  injects a failure of the lidar
/xtdrone/scene (subscribed)        xtdrone_msgs/SceneState       poses of links and actors
/xtdrone/models (subscribed)       xtdrone_msgs/SceneModels      models added and deleted since the start
/xtdrone/vehicles (subscribed)     std_msgs/String               vehicles that join and leave
=================================  ============================  ======================================================

T is a vehicle, e.g. ``iris_0``, NAME the name of its lidar, e.g. ``scan``.

Scan k of a lidar begins at k / rate s. Another thread casts it in the turn in which the scene that covers its last ray
has arrived, and it is published a fixed simulated time later; simulated time continues during the casting and waits
only for the publication. Lidars without subscribers cast no rays. The lidars of a vehicle that joins scan from its
first scene on; when it leaves, a scan in progress is lost and its topics end.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import rospy
from sensor_msgs.msg import LaserScan, PointCloud2
from xtdrone_msgs.msg import SceneModels, SceneState

from xtdrone_control import lockstep
from xtdrone_control.fleet import Vehicle
from xtdrone_control.lockstep.deferred_work import Deferred
from xtdrone_control.programs.node_command_line import ArgumentError, check_no_arguments, fleet_of
from xtdrone_control.settings import Settings, setting
from xtdrone_sim.lidars.lidar_messages import scan_message
from xtdrone_sim.lidars.ray_patterns import read_pattern
from xtdrone_sim.lidars.scan_measurement import Motion, Scan, begin_us, cast_scan, end_us, measured
from xtdrone_sim.lidars.scene_history import SceneHistory
from xtdrone_sim.rays.live_rays import LiveRays, scene_of
from xtdrone_sim.sensors.ranging_failures import FailureServices, RangingFailure
from xtdrone_sim.sensors.sensor_nodes import Due, private_parameters, rate_setting
from xtdrone_sim.topics.fleet_changes import FleetChanges, vehicles_may_join
from xtdrone_sim.vehicles.mounts.fleet_sensor import Lidar, lidars_of
from xtdrone_sim.vehicles.mounts.lidar_mounts import LEAST_RATE, MOST_RATE, ROSETTE, LidarMount

USAGE = "lidars.py"
TURNS = 50.0  # Hz, rate of /xtdrone/scene

_NAME = "lidars"
_MOST_WORKERS = 4


@dataclass(frozen=True)
class LidarSettings(Settings):
    """Private parameters of the node."""

    rate: float = rate_setting(
        LEAST_RATE, MOST_RATE, "scans per second of each lidar, 0 for the rate in its vehicle's file"
    )
    latency: float = setting(
        0.04, low=0.0, high=10.0, unit="s", text="simulated time from the end of a scan to its publication"
    )
    skew: bool = setting(True, text="false: all lidars cast all rays at the beginning of the scan")

    def applied(self, mount: LidarMount) -> LidarMount:
        """Return a lidar with these settings."""
        return replace(mount, rate=self.rate or mount.rate, skew=mount.skew and self.skew)


class _Done(NamedTuple):
    """A scan and its message."""

    scan: Scan
    message: LaserScan | PointCloud2


@dataclass(eq=False)
class _Station:
    """A lidar with its topic, its scans that are due, and the latest scan.

    Attributes:
        joins: whether its vehicle has joined in flight and has not been in a scene yet.
    """

    lidar: Lidar
    publisher: lockstep.Publisher
    due: Due
    joins: bool
    last: Scan | None = None


class _Shot(NamedTuple):
    """A scan in progress and its number."""

    station: _Station
    number: int


def _scanned(lidar: Lidar, number: int, motion: Motion, own: int, failure: RangingFailure) -> _Done:
    """Cast and measure a scan; called in a thread of its own."""
    rays, hits = cast_scan(lidar.mount, number, motion, own)
    scan = measured(lidar.mount, lidar.vehicle, number, rays, hits, failure.bias, failure.dropouts)
    return _Done(scan, scan_message(lidar, number, scan))


class LidarNode:
    """Casts and publishes scans, turn by turn."""

    def __init__(self, fleet: Sequence[Vehicle], settings: LidarSettings) -> None:
        """Advertise topics and services.

        Args:
            fleet: all vehicles, whose lidars are served.
            settings: see ``LidarSettings``.

        Raises:
            ValueError: a vehicle type or a pattern cannot be used.
        """
        self._settings = settings
        self._latency_us = round(settings.latency * 1e6)
        self._stations: list[_Station] = []
        self._failures = FailureServices()
        self._history = SceneHistory(0)
        self._rays = LiveRays(_NAME)
        self._deferred = Deferred(min(_MOST_WORKERS, len(os.sched_getaffinity(0))), wait=lockstep.is_active())
        for lidar in usable_lidars(fleet):
            self._serve(lidar, joins=False)
        lockstep.Subscriber("/xtdrone/scene", SceneState, self._take_scene)
        lockstep.Subscriber("/xtdrone/models", SceneModels, self._rays.change)
        self._changes = FleetChanges(fleet, self._join, self._leave)
        lockstep.add_reset_hook(self._restart)

    def begin(self, world: str) -> None:
        """Start scanning in a world, given by name or file."""
        self._rays.begin(world, self._changes.fleet)

    def _serve(self, lidar: Lidar, *, joins: bool) -> None:
        lidar = replace(lidar, mount=self._settings.applied(lidar.mount))
        publisher = lockstep.Publisher(lidar.topic, LaserScan if lidar.mount.kind == "scan" else PointCloud2)
        self._failures.add(lidar.topic)
        self._history.reach_back(round(1e6 * lidar.mount.duration))
        self._stations.append(_Station(lidar, publisher, Due(lidar.mount.rate, int(lidar.mount.skew)), joins))

    def _join(self, vehicle: Vehicle) -> None:
        lidars = usable_lidars([vehicle])
        self._rays.add_vehicle(vehicle)
        for lidar in lidars:
            self._serve(lidar, joins=True)

    def _leave(self, vehicle: Vehicle) -> None:
        self._rays.remove_vehicle(vehicle)
        for station in [station for station in self._stations if station.lidar.vehicle == vehicle.name]:
            self._stations.remove(station)
            self._failures.remove(station.lidar.topic)
            station.publisher.unregister()

    def _take_scene(self, message: SceneState) -> None:
        self._history.add(message.header.stamp.to_nsec() // 1000, scene_of(message))

    def _restart(self) -> None:
        """Discard the state from before a reset of simulated time, except failures."""
        self._deferred.clear()
        self._history.clear()
        for station in self._stations:
            station.due.restart()
            station.last = None

    def step(self) -> None:
        """Publish the scans and cast those that are due."""
        now_us = rospy.Time.now().to_nsec() // 1000
        for shot, done in self._deferred.ready(now_us):
            if shot.station in self._stations:
                self._publish(shot, done)
        last_us = self._history.last_us
        if last_us is None:
            return
        for station in self._stations:
            first_us = self._history.first_with(station.lidar.link) if station.joins else self._history.first_us
            if first_us is None:
                continue
            station.joins = False
            for number in station.due.numbers(first_us, last_us):
                if station.publisher.get_num_connections() and self._failures[station.lidar.topic].kind != "off":
                    self._begin(station, number, now_us)

    def _begin(self, station: _Station, number: int, now_us: int) -> None:
        rays, lidar = self._rays.scene(), station.lidar
        if rays is None:
            return
        begin, end = begin_us(lidar.mount, number), end_us(lidar.mount, number)
        motion = self._history.motion(rays, lidar.link, begin, end)
        if motion is None:
            rospy.logwarn_throttle(10.0, f"/xtdrone/scene has no {lidar.link}: no scans of its lidar")
            return
        own, failure = rays.number(lidar.vehicle), self._failures[lidar.topic]
        shot = _Shot(station, number)
        self._deferred.put(shot, now_us + self._latency_us, _scanned, lidar, number, motion, own, failure)

    def _publish(self, shot: _Shot, done: _Done) -> None:
        station = shot.station
        failure = self._failures[station.lidar.topic]
        if failure.kind == "off":
            return
        message = done.message
        if failure.kind == "frozen" and station.last is not None:
            message = scan_message(station.lidar, shot.number, station.last)
        else:
            station.last = done.scan
        station.publisher.publish(message)

    def close(self) -> None:
        """End the casting."""
        self._failures.close()
        self._deferred.close()


def usable_lidars(fleet: Sequence[Vehicle]) -> tuple[Lidar, ...]:
    """Return all lidars of vehicles, after reading their patterns.

    Raises:
        ValueError: a vehicle type or a pattern cannot be used.
    """
    lidars = lidars_of(fleet)
    for lidar in lidars:
        if lidar.mount.kind == "pattern" and lidar.mount.pattern != ROSETTE:
            read_pattern(lidar.mount.pattern_file)
    return lidars


def main(arguments: Sequence[str]) -> None:
    """Serve all lidars of the fleet until shutdown.

    Raises:
        ArgumentError: an argument or parameter is not allowed.
    """
    check_no_arguments(arguments)
    parameters: dict[str, Any] = private_parameters(_NAME, sys.argv)
    text = str(parameters.get("fleet") or rospy.get_param("/xtdrone/fleet", "iris_2d_lidar"))
    fleet = fleet_of(text) or ()
    try:
        settings = LidarSettings.from_parameters(lambda name, default: parameters.get(name[1:], default))
        lidars = usable_lidars(fleet)
    except ValueError as error:
        raise ArgumentError(str(error)) from error
    if not lidars and not vehicles_may_join():
        raise ArgumentError(f"/xtdrone/fleet: no vehicle of {text!r} has a lidar")
    lockstep.init_node(_NAME, rate=TURNS)
    node = LidarNode(fleet, settings)
    try:
        lockstep.start()  # returns when the simulator is running and has set the world
        node.begin(str(rospy.get_param("~world", rospy.get_param("/xtdrone/world", "empty"))))
        lockstep.spin(node.step)
    finally:
        node.close()
