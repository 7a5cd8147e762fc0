"""Poses and their arithmetic: unit quaternions (w, x, y, z), positions in metres."""

from __future__ import annotations

import math
from dataclasses import dataclass

from xtdrone_common.cameras.camera_pose import LINK_FROM_OPTICAL
from xtdrone_common.rotation import Quaternion, Vector, multiply


@dataclass(frozen=True)
class Pose:
    """Position and orientation in the parent frame."""

    position: Vector = (0.0, 0.0, 0.0)
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)


OPTICAL_FRAME = Pose(orientation=LINK_FROM_OPTICAL)
"""The optical frame of a camera in its link."""


def from_axis_angle(axis: Vector, angle: float) -> Quaternion:
    """Return the rotation by ``angle`` (rad) about a unit vector."""
    s = math.sin(0.5 * angle)
    return math.cos(0.5 * angle), axis[0] * s, axis[1] * s, axis[2] * s


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Return ``v`` rotated by ``q``, as the product q v q*."""
    _, x, y, z = multiply(multiply(q, (0.0, *v)), conjugate(q))
    return x, y, z


def conjugate(q: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    return q[0], -q[1], -q[2], -q[3]


def compose(outer: Pose, inner: Pose) -> Pose:
    """Return ``inner``, given relative to ``outer``, in the frame of reference of ``outer``."""
    x, y, z = rotate(outer.orientation, inner.position)
    ox, oy, oz = outer.position
    return Pose((ox + x, oy + y, oz + z), multiply(outer.orientation, inner.orientation))


def inverse(pose: Pose) -> Pose:
    """Return the inverse transformation of ``pose``."""
    back = conjugate(pose.orientation)
    x, y, z = rotate(back, pose.position)
    return Pose((-x, -y, -z), back)
