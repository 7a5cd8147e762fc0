"""The measurements of one vehicle's sensor, from its topics into its local map.

===================================  =======================  ========================================================
topic (subscribed)                   type                     meaning
===================================  =======================  ========================================================
/T/mavros/local_position/pose        geometry_msgs/PoseStamped  the estimate, at whose poses measurements are entered
/T/LIDAR                             sensor_msgs/PointCloud2  of a spinning lidar, or any cloud in the sensor's frame
/T/DEPTH/image_raw, camera_info      Image, CameraInfo        with ``~sensor`` depth, instead
===================================  =======================  ========================================================
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np
import rospy
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from xtdrone_control import lockstep
from xtdrone_control.settings import Settings, setting
from xtdrone_planning.mapping.local_map import LocalMap
from xtdrone_planning.mapping.map_messages import depths_of
from xtdrone_planning.mapping.range_images import (
    DepthImages,
    DepthMapping,
    LidarImages,
    LidarMapping,
    RangeImage,
    ScanError,
    points_of,
)
from xtdrone_planning.mapping.sensor_watch import SensorWatch

_INTRINSICS = (0, 4, 2, 5)  # fx, fy, cx, cy in K


@dataclass(frozen=True)
class SensorChoice(Settings):
    """Which sensor maps."""

    sensor: str = setting(
        "lidar", choices=("lidar", "depth"), text="what maps: a lidar's cloud or a depth camera's picture"
    )


class MapFeed:
    """Feeds a local map."""

    def __init__(
        self,
        vehicle: str,
        local_map: LocalMap,
        watch: SensorWatch,
        sensor: str,
        lidar: LidarMapping,
        depth: DepthMapping,
        timed: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        """Declare the topics.

        Args:
            vehicle: name, as ``iris_0``.
            local_map: is fed.
            watch: judges the sensor.
            sensor: lidar or depth.
            lidar, depth: of the sensor.
            timed: returns a context in which each measurement is read and entered.
        """
        self._timed = timed
        self._vehicle = vehicle
        self._map = local_map
        self._watch = watch
        self._mount = lidar.lidar_position if sensor == "lidar" else depth.depth_position
        self._lidar, self._depth = LidarImages(lidar), DepthImages(depth)
        self._intrinsics: tuple[float, float, float, float] | None = None
        lockstep.Subscriber(f"/{vehicle}/mavros/local_position/pose", PoseStamped, self._on_pose)
        if sensor == "lidar":
            lockstep.Subscriber(f"/{vehicle}/{lidar.lidar_topic}", PointCloud2, self._on_cloud, queue_size=1)
        else:
            lockstep.Subscriber(f"/{vehicle}/{depth.depth_topic}/camera_info", CameraInfo, self._on_info, queue_size=1)
            lockstep.Subscriber(f"/{vehicle}/{depth.depth_topic}/image_raw", Image, self._on_image, queue_size=1)

    def _on_pose(self, message: PoseStamped) -> None:
        p, q = message.pose.position, message.pose.orientation
        entry = np.array([p.x, p.y, p.z, q.w, q.x, q.y, q.z])
        if np.isfinite(entry).all():
            self._map.poses.add(message.header.stamp.to_nsec(), entry)

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
            self._watch.rejected(f"a measurement cannot be read: {error}")
            rospy.logwarn_throttle(5.0, f"{self._vehicle}: a measurement is not mapped: {error}")
            return
        if not self._watch.take(bytes(message.data), int(np.isfinite(image.ranges).sum())):
            return
        if self._map.enter(image, message.header.stamp.to_nsec(), self._mount):
            self._watch.mapped(rospy.get_time())
        else:
            self._watch.rejected("no pose is known for the sensor's measurements")
