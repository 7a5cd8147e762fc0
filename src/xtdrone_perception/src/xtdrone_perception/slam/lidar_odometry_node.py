"""ROS node for lidar odometry of one vehicle ``T``; ``odometry_node`` lists the topics of every odometry.

=========================================  ================================  =========================================
topic                                      type                              meaning
=========================================  ================================  =========================================
/T/velodyne_points (``~cloud``)            sensor_msgs/PointCloud2           in: with the points' times
/T/lidar_odometry/cloud                    sensor_msgs/PointCloud2           out: the deskewed scan, T/base_link
/T/lidar_odometry/local_map                sensor_msgs/PointCloud2           out, latched: ``~map_rate``, T/odom
=========================================  ================================  =========================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import rospy
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import PointScan, cloud_message, read_cloud
from xtdrone_common.pose_matrices import pose_of
from xtdrone_common.settings import setting

from .deskewing import ScanMotion
from .lidar_odometry import LidarOdometry, Registration, RegistrationOptions
from .odometry_health import HealthLimits
from .odometry_node import Job, OdometryNode, OdometryOptions, OdometrySource

_STILL = 0.05  # s assumed without motion for a cloud without times

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LidarOdometryOptions(OdometryOptions):
    """Private parameters of the node."""

    cloud: str = setting("velodyne_points", text="topic of the clouds below the vehicle's namespace")
    lidar_position: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.06), unit="m", text="position of the lidar in base_link"
    )
    lidar_rpy: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0), low=-2.0 * math.pi, high=2.0 * math.pi, unit="rad",
        text="roll, pitch, yaw of the sensor in base_link",
    )  # fmt: skip
    map_rate: float = setting(1.0, low=0.0, high=10.0, unit="Hz", text="publishing rate of the local map; 0: off")
    map_radius: float = setting(40.0, low=1.0, high=1000.0, unit="m", text="radius of the local map")


@dataclass(frozen=True)
class LidarHealthLimits(HealthLimits):
    """Private parameters of the supervision of lidar odometry.

    On a plain the information on horizontal translation is 0.001 of that on the height: what GICP gives the surface's
    own directions. The noise of walls makes it up to 0.007 along a corridor without ends, where registration slides by
    half a metre; a few trees among 2000 points on the ground make it 0.009, and registration agrees within 4 cm.
    """

    least_information: float = setting(
        0.0075, low=0.0, high=1.0, text="minimum information in the weakest direction, relative to the strongest"
    )


class _MovedScan(NamedTuple):
    """A scan and the vehicle's motion during it."""

    scan: PointScan
    motion: ScanMotion


class LidarOdometryNode(OdometryNode):
    """Topics and state of one vehicle with a 3D lidar."""

    def __init__(
        self, name: str, settings: LidarOdometryOptions, odometry: RegistrationOptions, limits: HealthLimits
    ) -> None:
        """Declare the topics.

        Args:
            name: Name of the vehicle.
            settings: Settings of the node.
            odometry: Settings of the registration.
            limits: Limits of the supervision.
        """
        super().__init__(name, OdometrySource("lidar_odometry", "scan", odometry.least_points), settings, limits)
        self._settings, self._registration = settings, odometry
        self._lidar = pose_of(settings.lidar_position, Rotation.from_euler("xyz", settings.lidar_rpy))
        self._cloud = lockstep.Publisher(f"/{name}/lidar_odometry/cloud", PointCloud2)
        self._map = lockstep.Publisher(f"/{name}/lidar_odometry/local_map", PointCloud2, latch=True)
        lockstep.Subscriber(f"/{name}/{settings.cloud}", PointCloud2, self._on_cloud, queue_size=4, buff_size=2**24)

    def _clear(self) -> None:
        super()._clear()
        self._next_map_ns = 0

    def _on_cloud(self, message: PointCloud2) -> None:
        try:
            scan = read_cloud(message)
        except ValueError as error:
            rospy.logwarn_throttle(10.0, f"{self._name}: cloud ignored: {error}")
            return
        if self._is_late():
            return
        begin_ns = message.header.stamp.to_nsec()
        duration = max(scan.duration, _STILL)
        end_ns = begin_ns + round(duration * 1e9)
        found = self._motion.during(begin_ns, duration)
        if found is None:
            self._warn_of_attitude()
            return
        self._submit(_MovedScan(scan, found[0]), scan.digest, end_ns)

    def _new_core(self, start: Array) -> LidarOdometry:
        return LidarOdometry(self._registration, self._lidar, start)

    def _register(self, core: LidarOdometry, job: Job, predicted: Array) -> Registration:
        scan: _MovedScan = job.payload
        return core.register(core.points_of(scan.scan, scan.motion), predicted)

    def _publish_more(self, found: Registration, stamp: rospy.Time) -> None:
        if self._cloud.get_num_connections():
            self._cloud.publish(cloud_message(found.points, stamp, self._frames.body))
        now_ns = stamp.to_nsec()
        if self._settings.map_rate and now_ns >= self._next_map_ns and self._map.get_num_connections():
            self._next_map_ns = now_ns + round(1e9 / self._settings.map_rate)
            core = self._core
            points = core.local_map(self._settings.map_radius) if isinstance(core, LidarOdometry) else np.empty((0, 3))
            self._map.publish(cloud_message(points, stamp, self._frames.odom))


def read_settings() -> tuple[LidarOdometryOptions, RegistrationOptions, LidarHealthLimits]:
    """Read the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    get: Any = rospy.get_param
    return (
        LidarOdometryOptions.from_parameters(get),
        RegistrationOptions.from_parameters(get),
        LidarHealthLimits.from_parameters(get),
    )
