"""Poses of ROS messages, whose quaternions are (x, y, z, w), as arrays with (w, x, y, z), and matrices as messages."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Transform, TransformStamped, Vector3
from numpy.typing import NDArray
from rospy import Time
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from xtdrone_common.frames import to_xyzw
from xtdrone_common.pose_matrices import quaternion_of

Array = NDArray[np.float64]

_UNIT = 0.01  # tolerance of a quaternion's squared norm


def is_pose(entry: Array) -> bool:
    """Return whether all numbers are finite and the last four are a unit quaternion, to 0.5 %."""
    return bool(np.isfinite(entry).all() and abs(entry[-4:] @ entry[-4:] - 1.0) < _UNIT)


def pose_entry(position: Point | Vector3, orientation: Quaternion) -> Array | None:
    """Return x, y, z (m) and the quaternion w, x, y, z of a message, (7,); None if ``is_pose`` is false."""
    p, q = position, orientation
    entry: Array = np.array([p.x, p.y, p.z, q.w, q.x, q.y, q.z])
    return entry if is_pose(entry) else None


def pose_message(pose: Array) -> Pose:
    """Return a pose (4, 4) as a message."""
    return Pose(Point(*pose[:3, 3].tolist()), Quaternion(*to_xyzw(quaternion_of(pose).tolist())))


def stamped_pose(pose: Array, stamp: Time, frame: str) -> PoseStamped:
    """Return a pose (4, 4) as a message with time and frame."""
    return PoseStamped(Header(stamp=stamp, frame_id=frame), pose_message(pose))


def transform_message(pose: Array, stamp: Time, parent: str, child: str) -> TFMessage:
    """Return a pose (4, 4) of ``child`` in ``parent`` for tf."""
    found = pose_message(pose)
    move = Transform(Vector3(*pose[:3, 3].tolist()), found.orientation)
    return TFMessage([TransformStamped(Header(stamp=stamp, frame_id=parent), child, move)])
