"""Arithmetic of ``visual.Pose``: rotations as unit quaternions (x, y, z, w), positions in metres."""

from __future__ import annotations

import math

from xtdrone_sim.vehicles.visual import Pose, Quaternion, Vector


def from_rpy(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the rotation by roll about x, then pitch about y, then yaw about z, fixed axes, rad (as URDF, SDF)."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def from_axis_angle(axis: Vector, angle: float) -> Quaternion:
    """Return the rotation by ``angle`` (rad) about a unit vector."""
    s = math.sin(0.5 * angle)
    return axis[0] * s, axis[1] * s, axis[2] * s, math.cos(0.5 * angle)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation ``b`` followed by ``a``."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate(q: Quaternion, v: Vector) -> Vector:
    """Return ``v`` rotated by ``q``."""
    x, y, z, _ = multiply(multiply(q, (*v, 0.0)), conjugate(q))
    return x, y, z


def conjugate(q: Quaternion) -> Quaternion:
    """Return the inverse rotation."""
    return -q[0], -q[1], -q[2], q[3]


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
