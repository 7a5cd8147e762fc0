"""Scalar quaternion and angle kernels; quaternions are (w, x, y, z) and turn body vectors into local ones."""

from __future__ import annotations

import math

from xtdrone_control.kernel import kernel


@kernel
def wrap_pi(angle):
    """Return ``angle`` (rad) wrapped to [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@kernel
def constrain(value, low, high):
    """Return ``value`` held between ``low`` and ``high``."""
    return min(max(value, low), high)


@kernel
def yaw_of(q):
    """Return the heading of ``q`` in radians."""
    return math.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))


@kernel
def multiply(a, b):
    """Return the product ``a b`` as a tuple."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@kernel
def conjugate_multiply(a, b):
    """Return ``conj(a) b`` as a tuple: the turn from a to b, seen in a."""
    return multiply((a[0], -a[1], -a[2], -a[3]), b)


@kernel
def rotate(q, x, y, z):
    """Return the body vector (x, y, z) turned into the local frame, as a tuple."""
    tx = 2.0 * (q[2] * z - q[3] * y)
    ty = 2.0 * (q[3] * x - q[1] * z)
    tz = 2.0 * (q[1] * y - q[2] * x)
    return (
        x + q[0] * tx + q[2] * tz - q[3] * ty,
        y + q[0] * ty + q[3] * tx - q[1] * tz,
        z + q[0] * tz + q[1] * ty - q[2] * tx,
    )


@kernel
def rotate_inverse(q, x, y, z):
    """Return the local vector (x, y, z) turned into the body frame, as a tuple."""
    return rotate((q[0], -q[1], -q[2], -q[3]), x, y, z)


@kernel
def exponential(x, y, z):
    """Return the quaternion of the rotation vector (x, y, z) in radians, as a tuple."""
    angle = math.sqrt(x * x + y * y + z * z)
    half = 0.5 * angle
    # sin(half)/angle, by its series where the quotient loses digits
    scale = math.sin(half) / angle if angle > 1e-4 else 0.5 - angle * angle / 48.0
    return math.cos(half), x * scale, y * scale, z * scale


@kernel
def integrate(q, x, y, z):
    """Turn the record field ``q`` in place by the body rotation vector (x, y, z) in radians, and normalise it."""
    assign_unit(q, multiply(q, exponential(x, y, z)))


@kernel
def assign_unit(q, value):
    """Write the quaternion ``value`` (tuple), made of length 1, into the record field ``q``."""
    w, i, j, k = value
    norm = 1.0 / math.sqrt(w * w + i * i + j * j + k * k)
    q[0] = w * norm
    q[1] = i * norm
    q[2] = j * norm
    q[3] = k * norm


@kernel
def from_euler(roll, pitch, yaw):
    """Return the quaternion of the z-y-x Euler angles (rad) as a tuple."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


@kernel
def from_axes(x, y, z):
    """Return the quaternion whose body axes are the local unit vectors ``x``, ``y``, ``z`` (tuples), as a tuple."""
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
