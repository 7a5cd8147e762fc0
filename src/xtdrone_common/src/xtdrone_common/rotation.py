"""Rotations by unit quaternions (w, x, y, z) from the body to the local frame, on scalars and tuples.

Functions of plain floats, which ``rotation_kernels`` compiles for the inner loops. The last three are for arrays, shape
(..., 4), with NaN and quaternions of any length, which logs contain; scipy's Rotation, whose quaternions are
(x, y, z, w), raises an error there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def wrap_pi(angle: float) -> float:
    """Return ``angle`` (rad) wrapped to [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


def wrap_pi_by_remainder(angle: float) -> float:
    """Return ``angle`` (rad, finite) wrapped to [-pi, pi), with different rounding from ``wrap_pi``.

    MAVROS's frames use this one and the autopilot the other; exchanging them would change the last bits of flights.
    """
    wrapped = math.fmod(angle + math.pi, 2.0 * math.pi)
    return wrapped + math.pi if wrapped < 0.0 else wrapped - math.pi


def constrain(value: float, low: float, high: float) -> float:
    """Return ``value`` limited to [``low``, ``high``]."""
    return min(max(value, low), high)


def yaw_of(q: Sequence[float]) -> float:
    """Return the yaw of a unit quaternion, rad, in [-pi, pi]."""
    return math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))


def multiply(a: Sequence[float], b: Sequence[float]) -> Quaternion:
    """Return the product ``a b``: rotation ``b`` followed by ``a``."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def rotate(q: Sequence[float], x: float, y: float, z: float) -> Vector:
    """Return the body vector (x, y, z) in the local frame."""
    tx = 2.0 * (q[2] * z - q[3] * y)
    ty = 2.0 * (q[3] * x - q[1] * z)
    tz = 2.0 * (q[1] * y - q[2] * x)
    return (
        x + q[0] * tx + q[2] * tz - q[3] * ty,
        y + q[0] * ty + q[3] * tx - q[1] * tz,
        z + q[0] * tz + q[1] * ty - q[2] * tx,
    )


def rotate_inverse(q: Sequence[float], x: float, y: float, z: float) -> Vector:
    """Return the local vector (x, y, z) in the body frame."""
    return rotate((q[0], -q[1], -q[2], -q[3]), x, y, z)


def exponential(x: float, y: float, z: float) -> Quaternion:
    """Return the quaternion of the rotation vector (x, y, z), rad."""
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * angle
    # sin(half)/angle; its series for small angles, where the quotient loses digits
    scale = math.sin(half) / angle if angle > 1e-4 else 0.5 - angle * angle / 48.0
    return math.cos(half), x * scale, y * scale, z * scale


def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the quaternion of the z-y-x Euler angles, rad: yaw, then pitch, then roll about body axes."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def to_euler(q: Sequence[float]) -> Vector:
    """Return roll, pitch and yaw of a unit quaternion, rad; pitch in [-pi/2, pi/2], the others in [-pi, pi]."""
    w, x, y, z = q
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x))))
    return roll, pitch, yaw_of(q)


def from_axes(x: Vector, y: Vector, z: Vector) -> Quaternion:
    """Return the quaternion whose body axes are the local unit vectors ``x``, ``y``, ``z``."""
    trace = x[0] + y[1] + z[2]
    if trace > 0.0:
        s = math.sqrt(trace + 1.0)
        f = 0.5 / s
        return (0.5 * s, (y[2] - z[1]) * f, (z[0] - x[2]) * f, (x[1] - y[0]) * f)
    if x[0] >= y[1] and x[0] >= z[2]:
        s = math.sqrt(1.0 + x[0] - y[1] - z[2])
        f = 0.5 / s
        return ((y[2] - z[1]) * f, 0.5 * s, (x[1] + y[0]) * f, (z[0] + x[2]) * f)
    if y[1] >= z[2]:
        s = math.sqrt(1.0 + y[1] - x[0] - z[2])
        f = 0.5 / s
        return ((z[0] - x[2]) * f, (x[1] + y[0]) * f, 0.5 * s, (y[2] + z[1]) * f)
    s = math.sqrt(1.0 + z[2] - x[0] - y[1])
    f = 0.5 / s
    return ((x[1] - y[0]) * f, (z[0] + x[2]) * f, (y[2] + z[1]) * f, 0.5 * s)


def yaws_of(q: Array) -> Array:
    """Return the yaw, rad, in [-pi, pi], shape (...)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    yaw: Array = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def to_eulers(q: Array) -> tuple[Array, Array, Array]:
    """Return roll, pitch and yaw, rad, of shape (...); pitch in [-pi/2, pi/2], the others in [-pi, pi]."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    return roll, pitch, yaws_of(q)


def rotate_all_inverse(q: Array, vectors: Array) -> Array:
    """Return local vectors (..., 3) in the body frame of unit quaternions (..., 4)."""
    w, axis = q[..., :1], -q[..., 1:]
    twice = 2.0 * np.cross(axis, vectors)
    turned: Array = vectors + w * twice + np.cross(axis, twice)
    return turned
