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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import rospy
from sensor_msgs.msg import LaserScan, PointCloud2
from xtdrone_msgs.msg import SceneState

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import Vehicle
from xtdrone_common.settings import Settings, setting
from xtdrone_lockstep.deferred_work import Deferred
from xtdrone_sim.lidars.lidar_messages import scan_message
from xtdrone_sim.lidars.ray_patterns import read_pattern
from xtdrone_sim.lidars.scan_measurement import Motion, Scan, begin_us, cast_scan, end_us, measure_scan
from xtdrone_sim.lidars.scene_history import SceneHistory
from xtdrone_sim.rays.live_rays import scene_of
from xtdrone_sim.sensors.ranging_failures import RangingFailure
from xtdrone_sim.sensors.ranging_node import RangingNode, Station, run_ranging_node
from xtdrone_sim.sensors.sensor_nodes import Due, rate_setting
from xtdrone_sim.vehicles.mounts.body_sensors import LEAST_RATE, MOST_RATE
from xtdrone_sim.vehicles.mounts.fleet_sensor import Lidar, lidars_of
from xtdrone_sim.vehicles.mounts.lidar_mounts import ROSETTE, LidarMount

USAGE = "lidars.py"

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

    def apply_to(self, mount: LidarMount) -> LidarMount:
        """Return a lidar with these settings."""
        return replace(mount, rate=self.rate or mount.rate, skew=mount.skew and self.skew)


class _Done(NamedTuple):
    """A scan and its message."""

    scan: Scan
    message: LaserScan | PointCloud2


class _Shot(NamedTuple):
    """A scan in progress and its number."""

    station: Station
    number: int


def _scan(lidar: Lidar, number: int, motion: Motion, own: int, failure: RangingFailure) -> _Done:
    """Cast and measure a scan; called in a thread of its own."""
    rays, hits = cast_scan(lidar.mount, number, motion, own)
    scan = measure_scan(lidar.mount, lidar.vehicle, number, rays, hits, failure.bias, failure.dropouts)
    return _Done(scan, scan_message(lidar, number, scan))


class LidarNode(RangingNode[Station]):
    """Casts and publishes scans, turn by turn."""

    name = "lidars"
    kind = "lidar"

    def __init__(self, fleet: Sequence[Vehicle], settings: LidarSettings) -> None:
        """Advertise topics and services; see ``RangingNode``."""
        self._settings = settings
        self._latency_us = round(settings.latency * 1e6)
        self._history = SceneHistory(0)
        self._deferred = Deferred(min(_MOST_WORKERS, len(os.sched_getaffinity(0))), wait=lockstep.is_active())
        super().__init__(fleet)

    @staticmethod
    def find(fleet: Sequence[Vehicle]) -> tuple[Lidar, ...]:
        """Return all lidars of vehicles, after reading their patterns.

        Raises:
            ValueError: a vehicle type or a pattern cannot be used.
        """
        lidars = lidars_of(fleet)
        for lidar in lidars:
            if lidar.mount.kind == "pattern" and lidar.mount.pattern != ROSETTE:
                read_pattern(lidar.mount.pattern_file)
        return lidars

    def _serve(self, sensors: Sequence[Lidar], *, joins: bool) -> None:
        for lidar in sensors:
            lidar = replace(lidar, mount=self._settings.apply_to(lidar.mount))
            publisher = lockstep.Publisher(lidar.topic, LaserScan if lidar.mount.kind == "scan" else PointCloud2)
            self._failures.add(lidar.topic)
            self._history.reach_back(round(1e6 * lidar.mount.duration))
            self._stations.append(Station(lidar, publisher, Due(lidar.mount.rate, int(lidar.mount.skew)), joins))

    def _take_scene(self, message: SceneState) -> None:
        self._history.add(message.header.stamp.to_nsec() // 1000, scene_of(message))

    def _restart(self) -> None:
        self._deferred.clear()
        self._history.clear()
        super()._restart()

    def _first_us(self, station: Station) -> int | None:
        return self._history.first_with(station.sensor.link) if station.joins else self._history.first_us

    def step(self) -> None:
        """Publish the scans and cast those that are due."""
        now_us = rospy.Time.now().to_nsec() // 1000
        for shot, done in self._deferred.ready(now_us):
            if shot.station in self._stations:
                self._publish(shot, done)
        last_us = self._history.last_us
        if last_us is not None:
            for station, number in self._due(last_us):
                self._begin(station, number, now_us)

    def _begin(self, station: Station, number: int, now_us: int) -> None:
        rays, lidar = self._rays.scene(), station.sensor
        if rays is None:
            return
        begin, end = begin_us(lidar.mount, number), end_us(lidar.mount, number)
        motion = self._history.motion(rays, lidar.link, begin, end)
        if motion is None:
            rospy.logwarn_throttle(10.0, f"/xtdrone/scene has no {lidar.link}: no scans of its lidar")
            return
        own, failure = rays.number(lidar.vehicle), self._failure(station)
        shot = _Shot(station, number)
        self._deferred.put(shot, now_us + self._latency_us, _scan, lidar, number, motion, own, failure)

    def _publish(self, shot: _Shot, done: _Done) -> None:
        station = shot.station
        failure = self._failure(station)
        if failure.kind == "off":
            return
        message = done.message
        if failure.kind == "frozen" and station.last is not None:
            message = scan_message(station.sensor, shot.number, station.last)
        else:
            station.last = done.scan
        station.publisher.publish(message)

    def close(self) -> None:
        """End the casting and the services."""
        super().close()
        self._deferred.close()


def main(arguments: Sequence[str]) -> None:
    """Serve all lidars of the fleet until shutdown.

    Raises:
        ArgumentError: an argument or parameter is not allowed.
    """
    run_ranging_node(LidarNode, LidarSettings, "iris_2d_lidar", arguments)
