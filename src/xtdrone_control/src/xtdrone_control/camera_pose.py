"""Pose of a camera on a gimbal, from the vehicle's pose and the gimbal's orientation.

The orientation is MAVROS's ``mount_control/orientation``: the rotation from the camera (x ahead, y right, z down) to
the level frame along the vehicle's heading (x ahead, y right, z down). As in MAVLink's MOUNT_ORIENTATION, pitch is
positive upwards and yaw positive to the right. Quaternions are (x, y, z, w) in all functions of this module.
"""

from __future__ import annotations

from typing import NamedTuple

from xtdrone_control import frames, rotation

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

_LINK_FROM_OPTICAL = (0.5, -0.5, 0.5, -0.5)  # (w, x, y, z): optical z is ahead, x right, y down


class CameraPose(NamedTuple):
    """A pose in ``map``.

    Attributes:
        position: m.
        orientation: (x, y, z, w), rotation from the camera frame to ``map``.
    """

    position: Vector
    orientation: Quaternion


def camera_link_pose(position: Vector, attitude: Quaternion, mount: Quaternion, offset: Vector) -> CameraPose:
    """Return the pose of the camera's link (x ahead, y left, z up).

    Args:
        position: position of base_link in ``map``, m, ENU.
        attitude: attitude of base_link (FLU) in ``map``, a unit quaternion.
        mount: orientation of the gimbal, a unit quaternion.
        offset: offset of the camera from base_link, m, FLU.
    """
    body = _to_wxyz(attitude)
    shift = frames.rotate(body, offset)
    heading = frames.quaternion_from_rpy(0.0, 0.0, frames.yaw_from_quaternion(body))
    x, y, z, w = mount
    camera = (position[0] + shift[0], position[1] + shift[1], position[2] + shift[2])
    return CameraPose(camera, _to_xyzw(rotation.multiply(heading, (w, x, -y, -z))))


def optical_pose(link: CameraPose) -> CameraPose:
    """Return the pose of the optical frame (x right, y down, z ahead) of a camera's link."""
    return CameraPose(link.position, _to_xyzw(rotation.multiply(_to_wxyz(link.orientation), _LINK_FROM_OPTICAL)))


def mount_orientation(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the gimbal's orientation for angles in rad; negative pitch looks down, yaw is relative to the heading."""
    return _to_xyzw(frames.quaternion_from_rpy(roll, pitch, yaw))


def _to_wxyz(q: Quaternion) -> frames.Quaternion:
    return q[3], q[0], q[1], q[2]


def _to_xyzw(q: frames.Quaternion) -> Quaternion:
    return q[1], q[2], q[3], q[0]
