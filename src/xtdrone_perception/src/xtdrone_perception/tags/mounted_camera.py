"""Pose of a board of tags in ``map``, from its pose in the image of a camera fixed to the vehicle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_control import rotation
from xtdrone_control.cameras.camera_pose import LINK_FROM_OPTICAL, CameraPose, rotation_matrix
from xtdrone_control.rotation import Quaternion, Vector

Array = NDArray[np.float64]


def optical_frame(position: Vector, attitude: Quaternion, offset: Vector, rpy: Vector) -> CameraPose:
    """Return the pose of a camera's optical frame in ``map``.

    Args:
        position: of base_link in ``map``, m, ENU.
        attitude: of base_link (FLU) in ``map``, a unit quaternion (w, x, y, z).
        offset: of the camera from base_link, m, FLU.
        rpy: of the camera's link (x ahead, y left, z up) in base_link, rad; (0, pi / 2, 0) looks down.
    """
    x, y, z = rotation_matrix(attitude) @ np.asarray(offset, float) + np.asarray(position, float)
    link = rotation.multiply(attitude, rotation.from_euler(*rpy))
    return CameraPose((float(x), float(y), float(z)), rotation.multiply(link, LINK_FROM_OPTICAL))


def in_map(camera: CameraPose, turn: Array, place: Array) -> tuple[Array, Array]:
    """Transform rotation, (3, 3), and position, (3,) m, from the optical frame to ``map``."""
    out = rotation_matrix(camera.orientation)
    return out @ turn, out @ place + np.asarray(camera.position)


def up_in(camera: CameraPose) -> Array:
    """Return the upward direction in the optical frame, (3,)."""
    return np.asarray(rotation_matrix(camera.orientation)[2])


def quaternion(turn: Array) -> Quaternion:
    """Return the quaternion (w, x, y, z) of a rotation matrix (3, 3)."""
    x, y, z = ((float(a), float(b), float(c)) for a, b, c in turn.T)
    return rotation.from_axes(x, y, z)
