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


def transform_points(pose: Array, points: Array) -> Array:
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


def predicted_pose(pose: Array, turn: Rotation, velocity: Array, seconds: float) -> Array:
    """Return a pose some time later.

    Args:
        pose: (4, 4).
        turn: rotation of the body meanwhile, in its axes.
        velocity: (3,) m/s, mean, in the map.
        seconds: of the time.
    """
    return pose_of(pose[:3, 3] + velocity * seconds, rotation_of(pose) * turn)


def distance_between(first: Array, second: Array) -> float:
    """Return the distance between two poses (4, 4), m."""
    return float(np.linalg.norm(second[:3, 3] - first[:3, 3]))


def angle_between(first: Array, second: Array) -> float:
    """Return the angle between two poses (4, 4), rad."""
    return float((rotation_of(first).inv() * rotation_of(second)).magnitude())


def move_pose(pose: Array, step: Array) -> Array:
    """Return a pose (4, 4) changed by a translation (m, reference axes) and a rotation vector (rad, body axes),
    (6,)."""
    return pose_of(pose[:3, 3] + step[:3], rotation_of(pose) * Rotation.from_rotvec(step[3:]))
