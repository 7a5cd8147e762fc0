"""Lever arms and delays of the aiding sensors (EKF2_*_POS_*, EKF2_*_DELAY)."""

from __future__ import annotations

from xtdrone_control.kernel import kernel
from xtdrone_control.rotation_kernels import rotate


@kernel
def to_origin(e, s, x, y, z, lag):
    """Return what to add to a sensor's position and velocity to obtain those of the body's origin now.

    Args:
        e, s: the vehicle's records.
        x, y, z: position of the sensor, m, body FRD.
        lag: s by which the sample is older than its time of arrival.

    Returns:
        Two 3-tuples, m and m/s, local.
    """
    wx, wy, wz = s.gyro[0] - e.gyro_bias[0], s.gyro[1] - e.gyro_bias[1], s.gyro[2] - e.gyro_bias[2]
    px, py, pz = rotate(e.q, x, y, z)
    vx, vy, vz = rotate(e.q, wy * z - wz * y, wz * x - wx * z, wx * y - wy * x)
    position = (e.velocity[0] * lag - px, e.velocity[1] * lag - py, e.velocity[2] * lag - pz)
    velocity = (e.acceleration[0] * lag - vx, e.acceleration[1] * lag - vy, e.acceleration[2] * lag - vz)
    return position, velocity
