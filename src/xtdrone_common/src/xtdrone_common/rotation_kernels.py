"""``rotation`` compiled for the inner loops, and kernels that write to records; quaternions are (w, x, y, z)."""

from __future__ import annotations

import math

from xtdrone_common import rotation
from xtdrone_common.kernel import kernel

wrap_pi = kernel(rotation.wrap_pi)
constrain = kernel(rotation.constrain)
yaw_of = kernel(rotation.yaw_of)
multiply = kernel(rotation.multiply)
rotate = kernel(rotation.rotate)
exponential = kernel(rotation.exponential)
from_euler = kernel(rotation.from_euler)
from_axes = kernel(rotation.from_axes)


@kernel
def conjugate_multiply(a, b):
    """Return ``conj(a) b`` as a tuple: the rotation from a to b, expressed in a."""
    return multiply((a[0], -a[1], -a[2], -a[3]), b)


@kernel
def rotate_inverse(q, x, y, z):
    """Return the local vector (x, y, z) in the body frame, as a tuple."""
    return rotate((q[0], -q[1], -q[2], -q[3]), x, y, z)


@kernel
def integrate(q, x, y, z):
    """Rotate the record field ``q`` in place by the body rotation vector (x, y, z), rad, and normalise it."""
    assign_unit(q, multiply(q, exponential(x, y, z)))


@kernel
def assign_unit(q, value):
    """Write the quaternion ``value`` (tuple), normalised, to the record field ``q``."""
    w, i, j, k = value
    norm = 1.0 / math.sqrt(w * w + i * i + j * j + k * k)
    q[0] = w * norm
    q[1] = i * norm
    q[2] = j * norm
    q[3] = k * norm
