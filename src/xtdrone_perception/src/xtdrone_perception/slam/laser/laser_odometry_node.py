"""ROS node for odometry of one vehicle ``T`` by a 2D laser; ``odometry_node`` lists the topics of every odometry.

=========================================  ================================  =========================================
topic                                      type                              meaning
=========================================  ================================  =========================================
/T/scan (``~scan``)                        sensor_msgs/LaserScan             in: full circle or a sector
/T/distance (``~distance``)                sensor_msgs/LaserScan             in: its first ray points down
/T/laser_odometry/local_map                sensor_msgs/PointCloud2           out, latched: ``~map_rate``, T/odom
=========================================  ================================  =========================================
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import rospy
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan, PointCloud2

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import ReadScan, cloud_message, read_scan
from xtdrone_common.settings import setting
from xtdrone_perception.slam.odometry_health import HealthLimits
from xtdrone_perception.slam.odometry_node import Job, OdometryNode, OdometryOptions, OdometrySource

from .laser_odometry import LaserEstimate, LaserOdometry, LaserSweep, ScanMatchSettings

_LEAST_DURATION = 0.01  # s
_OLD_NS = 300_000_000  # ns after which a range is too old

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LaserOdometryOptions(OdometryOptions):
    """Private parameters of the node."""

    scan: str = setting("scan", text="topic of the scans below the vehicle's namespace")
    distance: str = setting("distance", text="topic of the downward ranges below the vehicle's namespace")
    laser_position: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.06), unit="m", text="position of the laser in base_link"
    )
    laser_yaw: float = setting(
        0.0, low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad", text="yaw of the laser in base_link"
    )
    distance_below: float = setting(
        0.05, low=-10.0, high=10.0, unit="m", text="distance of the range finder below base_link's origin"
    )
    map_rate: float = setting(1.0, low=0.0, high=10.0, unit="Hz", text="publishing rate of the local map; 0: off")


class LaserOdometryNode(OdometryNode):
    """Topics and state of one vehicle with a 2D laser and a range finder."""

    def __init__(
        self, name: str, settings: LaserOdometryOptions, matching: ScanMatchSettings, limits: HealthLimits
    ) -> None:
        """Declare the topics.

        Args:
            name: Name of the vehicle.
            settings: Settings of the node.
            matching: Settings of the matching.
            limits: Limits of the supervision.
        """
        super().__init__(name, OdometrySource("laser_odometry", "scan", matching.least_points), settings, limits)
        self._settings, self._matching = settings, matching
        self._map = lockstep.Publisher(f"/{name}/laser_odometry/local_map", PointCloud2, latch=True)
        lockstep.Subscriber(f"/{name}/{settings.distance}", LaserScan, self._on_distance)
        lockstep.Subscriber(f"/{name}/{settings.scan}", LaserScan, self._on_scan, queue_size=4)

    def _clear(self) -> None:
        super()._clear()
        self._below: tuple[int, float] | None = None
        self._next_map_ns = 0

    def _on_distance(self, message: LaserScan) -> None:
        value = float(message.ranges[0]) if len(message.ranges) else math.inf
        if message.range_min <= value <= message.range_max:
            self._below = message.header.stamp.to_nsec(), value + self._settings.distance_below

    def _on_scan(self, message: LaserScan) -> None:
        try:
            scan = read_scan(message)
        except ValueError as error:
            rospy.logwarn_throttle(10.0, f"{self._name}: scan ignored: {error}")
            return
        begin_ns = message.header.stamp.to_nsec()
        duration = max(scan.duration, _LEAST_DURATION)
        end_ns = begin_ns + round(duration * 1e9)
        sweep = self._sweep(scan, begin_ns, duration, end_ns)
        if sweep is None:
            self._warn_of_attitude()
        elif not self._is_late():
            self._submit(sweep, zlib.crc32(np.asarray(message.ranges, "<f4").tobytes()), end_ns)

    def _sweep(self, scan: ReadScan, begin_ns: int, duration: float, end_ns: int) -> LaserSweep | None:
        """Return a scan with the vehicle's motion and height at its time; None if the attitude is unknown."""
        found = self._motion.during(begin_ns, duration)
        if found is None:
            return None
        motion, attitude = found
        sin, cos = math.sin(self._settings.laser_yaw), math.cos(self._settings.laser_yaw)
        turned = scan.points @ np.array([[cos, sin], [-sin, cos]])
        body = np.column_stack([turned, np.zeros(len(turned))]) + np.array(self._settings.laser_position)
        is_new = self._below is not None and abs(end_ns - self._below[0]) <= _OLD_NS
        below = self._below[1] if self._below is not None and is_new else None
        return LaserSweep(body, scan.times, motion, attitude, below)

    def _new_core(self, start: Array) -> LaserOdometry:
        return LaserOdometry(self._matching, start)

    def _register(self, core: LaserOdometry, job: Job, predicted: Array) -> LaserEstimate:
        return core.register(job.payload, predicted)

    def _publish_more(self, found: LaserEstimate, stamp: rospy.Time) -> None:
        now_ns = stamp.to_nsec()
        if self._settings.map_rate and now_ns >= self._next_map_ns and self._map.get_num_connections():
            self._next_map_ns = now_ns + round(1e9 / self._settings.map_rate)
            if isinstance(self._core, LaserOdometry):
                self._map.publish(cloud_message(self._core.map_points, stamp, self._frames.odom))


def read_settings() -> tuple[LaserOdometryOptions, ScanMatchSettings, HealthLimits]:
    """Read the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    get: Any = rospy.get_param
    return (
        LaserOdometryOptions.from_parameters(get),
        ScanMatchSettings.from_parameters(get),
        HealthLimits.from_parameters(get),
    )
