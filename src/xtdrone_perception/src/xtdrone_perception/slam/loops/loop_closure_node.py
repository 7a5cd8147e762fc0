"""ROS node for loop closure of one vehicle ``T``: corrects the drift of odometry in map.

================================  =========================  ======================================================
topic                             type                       meaning
================================  =========================  ======================================================
/T/lidar_odometry/odometry        nav_msgs/Odometry          in: T/odom to T/base_link
/T/lidar_odometry/cloud           sensor_msgs/PointCloud2    in: deskewed scans, T/base_link, with the same stamps
/T/slam/odometry                  nav_msgs/Odometry          out: map to T/base_link, with the current correction
/T/slam/path                      nav_msgs/Path              out, latched: the keyframes, as corrected by all loops
/tf                               tf2_msgs/TFMessage         out: map to T/odom, the correction
================================  =========================  ======================================================

The correction of a keyframe is published ``~latency`` of simulated time after it, however long the registration takes.
The autopilot stays in the odometry frame, in which poses do not jump; transform goals from map to T/odom by tf.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import rospy
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import PointCloud2
from tf2_msgs.msg import TFMessage

import xtdrone_lockstep as lockstep
from xtdrone_common.clouds import read_cloud
from xtdrone_common.pose_matrices import pose_of
from xtdrone_common.pose_messages import stamped_pose, transform_message
from xtdrone_common.settings import Settings, setting
from xtdrone_lockstep.deferred_work import Deferred
from xtdrone_perception.slam import odometry_messages as messages

from .loop_closure import LoopClosure, LoopOptions

RATE = 20.0  # Hz
_WAITING = 20  # scans kept until their odometry arrives

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LoopNodeOptions(Settings):
    """Private parameters of the node."""

    latency: float = setting(0.5, low=0.0, high=10.0, unit="s", text="simulated time from a keyframe to its correction")


class _Correction(NamedTuple):
    """Result of a keyframe."""

    pose: Array
    keyframes: list[Array]
    closed: bool


class VehicleLoops:
    """Topics and state of one vehicle."""

    def __init__(self, name: str, options: LoopOptions, settings: LoopNodeOptions) -> None:
        """Declare the topics."""
        self._name, self._options = name, options
        self._latency_us = round(settings.latency * 1e6)
        self._frames = messages.Frames("map", f"{name}/odom", f"{name}/base_link")
        self._deferred = Deferred(1, wait=lockstep.is_active())
        self._clear()
        self._odometry = lockstep.Publisher(f"/{name}/slam/odometry", Odometry)
        self._path = lockstep.Publisher(f"/{name}/slam/path", Path, latch=True)
        self._tf = lockstep.Publisher("/tf", TFMessage)
        lockstep.Subscriber(f"/{name}/lidar_odometry/odometry", Odometry, self._on_odometry)
        lockstep.Subscriber(f"/{name}/lidar_odometry/cloud", PointCloud2, self._on_cloud, buff_size=2**24)
        lockstep.add_reset_hook(self._restart)

    def _clear(self) -> None:
        self._loops = LoopClosure(self._options)
        self._correction = np.eye(4)
        self._clouds: dict[int, PointCloud2] = {}
        self._poses: dict[int, Array] = {}
        self._last: Array | None = None  # odometry of the last keyframe

    def _restart(self) -> None:
        self._deferred.close()
        self._deferred = Deferred(1, wait=lockstep.is_active())
        self._clear()

    def _on_odometry(self, message: Odometry) -> None:
        p, q = message.pose.pose.position, message.pose.pose.orientation
        pose = pose_of((p.x, p.y, p.z), Rotation.from_quat([q.x, q.y, q.z, q.w]))
        self._poses[message.header.stamp.to_nsec()] = pose
        corrected = self._correction @ pose
        stamp = message.header.stamp
        out = messages.odometry(
            corrected, np.zeros(3), np.reshape(message.pose.covariance, (6, 6)), stamp, self._frames
        )
        out.header.frame_id, out.twist = self._frames.map, message.twist
        self._odometry.publish(out)
        self._tf.publish(transform_message(self._correction, stamp, self._frames.map, self._frames.odom))

    def _on_cloud(self, message: PointCloud2) -> None:
        self._clouds[message.header.stamp.to_nsec()] = message

    def step(self) -> None:
        """Start processing due keyframes, and publish due corrections."""
        now = rospy.Time.now()
        for stamp, correction in self._deferred.ready(now.to_nsec() // 1000):
            self._correction = correction.pose
            poses = [stamped_pose(pose, stamp, self._frames.map) for pose in correction.keyframes]
            self._path.publish(messages.path(poses, stamp, self._frames.map))
            if correction.closed:
                shift = float(np.linalg.norm(correction.pose[:3, 3]))
                rospy.loginfo(f"{self._name}: loop closed; map to odom is now {shift:.2f} m")
        for stamp_ns in sorted(self._clouds.keys() & self._poses.keys()):
            self._take(self._clouds.pop(stamp_ns), self._poses.pop(stamp_ns), now)
        for waiting in (self._clouds, self._poses):
            for stamp_ns in sorted(waiting)[:-_WAITING]:
                del waiting[stamp_ns]

    def close(self) -> None:
        """End the worker."""
        self._deferred.close()

    def _take(self, cloud: PointCloud2, pose: Array, now: rospy.Time) -> None:
        if self._last is not None and np.linalg.norm(pose[:3, 3] - self._last[:3, 3]) < self._options.spacing:
            return
        try:
            points = read_cloud(cloud).points
        except ValueError as error:
            rospy.logwarn_throttle(10.0, f"{self._name}: cloud ignored: {error}")
            return
        self._last = pose
        due_us = now.to_nsec() // 1000 + self._latency_us
        self._deferred.put(cloud.header.stamp, due_us, _correct, self._loops, pose, points)


def _correct(loops: LoopClosure, pose: Array, points: Array) -> _Correction:
    closed = loops.add(pose, points)
    return _Correction(loops.correction, [entry.copy() for entry in loops.poses], closed)


def read_settings() -> tuple[LoopOptions, LoopNodeOptions]:
    """Read the private parameters.

    Raises:
        SettingError: a parameter is not allowed.
    """
    return LoopOptions.from_parameters(rospy.get_param), LoopNodeOptions.from_parameters(rospy.get_param)
