"""Feed of one vehicle's local map: subscribes to its sensor and pose, and inserts each measurement.

===================================  =========================  ======================================================
topic (subscribed)                   type                       meaning
===================================  =========================  ======================================================
/T/mavros/local_position/pose        geometry_msgs/PoseStamped  the estimated pose, used to place measurements
/T/ODOMETRY/odometry                 nav_msgs/Odometry          instead, with ``odometry``
/T/LIDAR                             sensor_msgs/PointCloud2    cloud of a spinning lidar, or any cloud in its frame
/T/DEPTH/image_raw, camera_info      Image, CameraInfo          instead, with ``~sensor`` depth
===================================  =========================  ======================================================
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import rospy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import ScanError, depths_of, points_of
from xtdrone_common.pose_history import PoseHistory
from xtdrone_common.settings import Settings, setting
from xtdrone_control.vehicle_topics import VehicleTopics
from xtdrone_planning.mapping.range_images import DepthImages, DepthMapping, LidarImages, LidarMapping, RangeImage
from xtdrone_planning.mapping.sensor_watch import SensorWatch, WatchSettings

_INTRINSICS = (0, 4, 2, 5)  # fx, fy, cx, cy in K


@dataclass(frozen=True)
class SensorChoice(Settings):
    """Which sensor maps."""

    sensor: str = setting(
        "lidar", choices=("lidar", "depth"), text="sensor that the map is built from: lidar cloud or depth image"
    )


class SensorSettings(NamedTuple):
    """All settings of the sensor that maps."""

    choice: SensorChoice = SensorChoice()
    lidar: LidarMapping = LidarMapping()
    depth: DepthMapping = DepthMapping()
    watch: WatchSettings = WatchSettings()

    @classmethod
    def read(cls) -> SensorSettings:
        """Return the settings of the private parameters.

        Raises:
            SettingError: A parameter is not allowed.
        """
        get = rospy.get_param
        lidar, depth = LidarMapping.from_parameters(get), DepthMapping.from_parameters(get)
        return cls(SensorChoice.from_parameters(get), lidar, depth, WatchSettings.from_parameters(get))


class FedMap(Protocol):
    """A map that measurements are inserted into."""

    @property
    def poses(self) -> PoseHistory:
        """Poses of base_link in map; see ``LocalMap``."""

    def enter(self, image: RangeImage, stamp_ns: int, mount: tuple[float, float, float]) -> bool:
        """Insert a measurement; return False if its pose is not known. See ``LocalMap.enter``."""


class MapFeed:
    """Feeds a map."""

    def __init__(
        self,
        vehicle: str,
        fed_map: FedMap,
        watch: SensorWatch,
        settings: SensorSettings,
        timed: Callable[[], AbstractContextManager[None]] = nullcontext,
        odometry: str = "",
    ) -> None:
        """Declare the topics.

        Args:
            vehicle: Name of the vehicle, as ``iris_0``.
            fed_map: Map to feed.
            watch: Supervision of the sensor.
            settings: Settings of the sensor.
            timed: Returns a context manager around reading and inserting each measurement.
            odometry: Name of the odometry whose poses are used; empty: the autopilot's estimate.
        """
        self._timed = timed
        self._vehicle = vehicle
        self._map = fed_map
        self._watch = watch
        is_lidar, lidar, depth = settings.choice.sensor == "lidar", settings.lidar, settings.depth
        self._mount = lidar.lidar_position if is_lidar else depth.depth_position
        self._lidar, self._depth = LidarImages(lidar), DepthImages(depth)
        self._intrinsics: tuple[float, float, float, float] | None = None
        VehicleTopics(vehicle, "pose", poses=fed_map.poses, odometry=odometry)
        if is_lidar:
            lockstep.Subscriber(f"/{vehicle}/{lidar.lidar_topic}", PointCloud2, self._on_cloud, queue_size=1)
        else:
            lockstep.Subscriber(f"/{vehicle}/{depth.depth_topic}/camera_info", CameraInfo, self._on_info, queue_size=1)
            lockstep.Subscriber(f"/{vehicle}/{depth.depth_topic}/image_raw", Image, self._on_image, queue_size=1)

    def _on_info(self, message: CameraInfo) -> None:
        fx, fy, cx, cy = (float(message.K[n]) for n in _INTRINSICS)
        self._intrinsics = fx, fy, cx, cy

    def _on_cloud(self, message: PointCloud2) -> None:
        self._enter(message, lambda: self._lidar.image(points_of(message)))

    def _on_image(self, message: Image) -> None:
        intrinsics = self._intrinsics
        if intrinsics is None:
            self._watch.rejected("no camera_info has been received")
            return
        self._enter(message, lambda: self._depth.image(depths_of(message), intrinsics))

    def _enter(self, message: PointCloud2 | Image, read: Callable[[], RangeImage]) -> None:
        with self._timed():
            self._read_and_enter(message, read)

    def _read_and_enter(self, message: PointCloud2 | Image, read: Callable[[], RangeImage]) -> None:
        try:
            image = read()
        except ScanError as error:
            self._watch.rejected(f"measurement rejected: {error}")
            rospy.logwarn_throttle(5.0, f"{self._vehicle}: measurement rejected: {error}")
            return
        if not self._watch.take(bytes(message.data), int(np.isfinite(image.ranges).sum())):
            return
        if self._map.enter(image, message.header.stamp.to_nsec(), self._mount):
            self._watch.mapped(rospy.get_time())
        else:
            self._watch.rejected("no pose at the time of the sensor's measurements")
