"""Functions of ``rotation`` for arrays of unit quaternions (w, x, y, z), shape (..., 4).

They accept NaN and quaternions of any length, which logs contain, where scipy's Rotation raises an error.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def yaw_of(q: Array) -> Array:
    """Return the yaw, rad, in [-pi, pi], shape (...)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    yaw: Array = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def to_euler(q: Array) -> tuple[Array, Array, Array]:
    """Return roll, pitch and yaw, rad, of shape (...); pitch in [-pi/2, pi/2], the others in [-pi, pi]."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return roll, pitch, yaw_of(q)


def rotate_inverse(q: Array, vectors: Array) -> Array:
    """Return local vectors (..., 3) in the body frame of unit quaternions (..., 4)."""
    w, axis = q[..., :1], -q[..., 1:]
    twice = 2.0 * np.cross(axis, vectors)
    turned: Array = vectors + w * twice + np.cross(axis, twice)
    return turned
