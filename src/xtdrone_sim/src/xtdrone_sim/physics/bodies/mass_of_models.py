"""Mass, centre of mass and principal moments of models."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.poses import Pose, compose, rotate
from xtdrone_control.rotation import Quaternion
from xtdrone_sim.worlds.sdf.world_records import DEFAULT_INERTIAL, SdfModel

Array = NDArray[np.float64]


def mass_of(model: SdfModel) -> tuple[float, Pose, Array]:
    """Return the mass of all links as one rigid body.

    Returns:
        Mass, kg; the principal axes at the centre of mass, in the model's frame; principal moments (3,), kg m^2.
    """
    inertials = [link.inertial or DEFAULT_INERTIAL for link in model.links]
    poses = [compose(link.pose, part.pose) for link, part in zip(model.links, inertials, strict=True)]
    mass = sum(part.mass for part in inertials)
    centre = np.zeros(3)
    for part, pose in zip(inertials, poses, strict=True):
        centre += part.mass / mass * np.array(pose.position)
    total = np.zeros((3, 3))
    for part, pose in zip(inertials, poses, strict=True):
        turn = np.array([rotate(pose.orientation, axis) for axis in _AXES]).T
        ixx, iyy, izz, ixy, ixz, iyz = part.inertia
        own = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        arm = np.array(pose.position) - centre
        total += turn @ own @ turn.T + part.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    moments, axes = _principal(total)
    x, y, z = centre.tolist()
    return float(mass), Pose((x, y, z), axes), moments


_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _principal(inertia: Array) -> tuple[Array, Quaternion]:
    """Return the principal moments and the rotation (w, x, y, z) from their axes; none if they are the frame's own."""
    if np.count_nonzero(inertia - np.diag(np.diag(inertia))) == 0:
        return np.diag(inertia).copy(), (1.0, 0.0, 0.0, 0.0)
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] = -axes[:, 0]
    return moments, _quaternion(axes)


def _quaternion(matrix: Array) -> Quaternion:
    """Return the quaternion (w, x, y, z) of a rotation matrix, from its eigenvector of the largest eigenvalue.

    I. Bar-Itzhack, "New method for extracting the quaternion from a rotation matrix", JGCD 23(6), 2000.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix.tolist()
    k = np.array(
        [
            [xx - yy - zz, yx + xy, zx + xz, zy - yz],
            [yx + xy, yy - xx - zz, zy + yz, xz - zx],
            [zx + xz, zy + yz, zz - xx - yy, yx - xy],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    x, y, z, w = np.linalg.eigh(k)[1][:, -1].tolist()
    return (w, x, y, z)
