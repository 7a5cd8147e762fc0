"""Rigid poses as 4 x 4 matrices: T maps points of a body into its reference frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def pose_of(position: Sequence[float] | Array, rotation: Rotation) -> Array:
    """Return the pose (4, 4) of a position (m) and a rotation."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), position
    return pose


def inverse(pose: Array) -> Array:
    """Return the inverse of a pose, (4, 4)."""
    found = np.eye(4)
    found[:3, :3] = pose[:3, :3].T
    found[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return found


def transformed(pose: Array, points: Array) -> Array:
    """Return points (n, 3) in the reference frame of a pose."""
    moved: Array = points @ pose[:3, :3].T + pose[:3, 3]
    return moved


def rotation_of(pose: Array) -> Rotation:
    """Return the rotation of a pose."""
    return Rotation.from_matrix(pose[:3, :3])


def quaternion_of(pose: Array) -> Array:
    """Return the rotation of a pose as a unit quaternion (w, x, y, z), w >= 0."""
    x, y, z, w = rotation_of(pose).as_quat(canonical=True)
    return np.array([w, x, y, z])


def vector_of(pose: Array) -> Array:
    """Return translation (m) and rotation vector (rad) of a pose, (6,)."""
    return np.concatenate([pose[:3, 3], rotation_of(pose).as_rotvec()])


def pose_of_vector(vector: Array) -> Array:
    """Return the pose of a translation (m) and a rotation vector (rad), (6,)."""
    return pose_of(vector[:3], Rotation.from_rotvec(vector[3:]))


def yaw_of(pose: Array) -> float:
    """Return the heading of a pose's x axis, rad, -pi..pi."""
    return float(np.arctan2(pose[1, 0], pose[0, 0]))


def turned_about_z(angle: float) -> Rotation:
    """Return the rotation by an angle (rad) about z."""
    return Rotation.from_rotvec([0.0, 0.0, angle])
