"""Pose of a camera on a gimbal, from the vehicle's pose and the gimbal's orientation.

The orientation is MAVROS's ``mount_control/orientation``: the rotation from the camera (x ahead, y right, z down) to
the level frame along the vehicle's heading (x ahead, y right, z down). As in MAVLink's MOUNT_ORIENTATION, pitch is
positive upwards and yaw positive to the right. Quaternions are (w, x, y, z).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common import frames, rotation
from xtdrone_common.rotation import Quaternion, Vector

LINK_FROM_OPTICAL: Quaternion = (0.5, -0.5, 0.5, -0.5)
"""Orientation of the optical frame (x right, y down, z ahead) in a camera's link (x ahead, y left, z up)."""


class CameraPose(NamedTuple):
    """A pose in ``map``.

    Attributes:
        position: m.
        orientation: rotation from the camera frame to ``map``.
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
    shift = frames.rotate(attitude, offset)
    heading = frames.quaternion_from_rpy(0.0, 0.0, frames.yaw_from_quaternion(attitude))
    w, x, y, z = mount
    camera = (position[0] + shift[0], position[1] + shift[1], position[2] + shift[2])
    return CameraPose(camera, rotation.multiply(heading, (w, x, -y, -z)))


def optical_pose(link: CameraPose) -> CameraPose:
    """Return the pose of the optical frame (x right, y down, z ahead) of a camera's link."""
    return CameraPose(link.position, rotation.multiply(link.orientation, LINK_FROM_OPTICAL))


def mount_orientation(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the gimbal's orientation for angles in rad; negative pitch points down, yaw is relative to the heading."""
    return frames.quaternion_from_rpy(roll, pitch, yaw)


def rotation_matrix(q: Sequence[float]) -> NDArray[np.float64]:
    """Return the (3, 3) matrix of the rotation by a unit quaternion."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
