"""Measurement updates and resets of the estimator's state, one scalar at a time; lever arms and delays of sensors.

Every measurement is a scalar with an innovation (measured minus predicted), a Jacobian row H with respect to the error
state, a variance R and a gate in standard deviations. The test ratio is innovation^2 / (gate^2 (H P H' + R)); a
measurement is fused when the ratio is at most 1. The error state is that of ``ekf``: the attitude error is a rotation
vector in the body frame, q_true = q * exp(dtheta).
"""

from __future__ import annotations

import math

from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import N_STATES
from xtdrone_common.rotation_kernels import integrate, multiply, rotate, wrap_pi

THETA, VEL, POS, BG, BA, BM = 0, 3, 6, 9, 12, 15
YAW_UNKNOWN_STD = 1.0  # rad, before the magnetometer has been fused
_FIELD_SAMPLES = 1000  # number of samples of the magnetic field's moving average
_LEVEL_LIMIT = 1e-4  # squared sine of the angle to the vertical below which the heading is undefined


@kernel
def correct(e, gain, row, innovation, variance):
    """Apply a scalar Kalman update: ``row`` = H P (N_STATES,), ``variance`` = H P H' + R; ``gain`` is scratch."""
    P = e.P
    inverse = 1.0 / variance
    for i in range(N_STATES):
        gain[i] = row[i] * inverse
    for i in range(N_STATES):
        for j in range(i + 1):
            P[i, j] -= gain[i] * row[j]
    for i in range(N_STATES):
        for j in range(i):
            P[j, i] = P[i, j]
    for i in range(N_STATES):
        gain[i] *= innovation
    integrate(e.q, gain[0], gain[1], gain[2])
    for i in range(3):
        e.velocity[i] += gain[VEL + i]
        e.position[i] += gain[POS + i]
        e.gyro_bias[i] += gain[BG + i]
        e.accel_bias[i] += gain[BA + i]
        e.mag_bias[i] += gain[BM + i]


@kernel
def fuse_state(e, index, innovation, noise_variance, gate, work):
    """Fuse a direct measurement of error state ``index``; return its test ratio."""
    variance = e.P[index, index] + noise_variance
    ratio = innovation * innovation / (gate * gate * variance)
    if ratio > 1.0:
        return ratio
    for i in range(N_STATES):
        work[1, i] = e.P[index, i]
    correct(e, work[0], work[1], innovation, variance)
    return ratio


@kernel
def _fuse_two_blocks(e, first, a, second, b, innovation, noise_variance, gate, work):
    """Fuse a scalar whose H is ``a`` (3-tuple) at index ``first`` and ``b`` at ``second``; return its test ratio."""
    row = work[1]
    for i in range(N_STATES):
        row[i] = (
            a[0] * e.P[first, i]
            + a[1] * e.P[first + 1, i]
            + a[2] * e.P[first + 2, i]
            + b[0] * e.P[second, i]
            + b[1] * e.P[second + 1, i]
            + b[2] * e.P[second + 2, i]
        )
    variance = noise_variance
    for i in range(3):
        variance += a[i] * row[first + i] + b[i] * row[second + i]
    ratio = innovation * innovation / (gate * gate * variance)
    if ratio <= 1.0:
        correct(e, work[0], row, innovation, variance)
    return ratio


@kernel
def magnetic_heading(e, s, declination):
    """Return the innovation of the magnetic heading against ``declination`` (rad), and its Jacobian.

    Without errors the sample minus the bias, rotated by the attitude into the local frame, points to the declination.
    The Jacobian is evaluated at the smoothed field (``track_field``) in the direction of the declination, not at the
    sample. At a constant heading yaw and bias are not separately observable, and noise in the Jacobian would make them
    appear so: noise in its direction is correlated with the innovation and makes both states drift; noise in its length
    makes each sample appear to observe a different share of the bias.

    Returns:
        The innovation (rad); its derivatives with respect to the attitude error and to the bias (3-tuples); 1, or 0 for
        a vertical field, which has no heading.
    """
    bx, by, bz = s.mag[0] - e.mag_bias[0], s.mag[1] - e.mag_bias[1], s.mag[2] - e.mag_bias[2]
    mx, my, mz = rotate(e.q, bx, by, bz)
    level = mx * mx + my * my
    if level < _LEVEL_LIMIT * (level + mz * mz):
        return 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0
    strength = e.field.strength
    cos, sin = math.cos(declination), math.sin(declination)
    w, x, y, z = e.q[0], -e.q[1], -e.q[2], -e.q[3]
    bx, by, bz = rotate((w, x, y, z), strength * cos, strength * sin, e.field.down)
    # the angle's derivative with respect to the local field is (-sin, cos, 0) / strength; in the body frame:
    gx, gy, gz = rotate((w, x, y, z), -sin / strength, cos / strength, 0.0)
    # an attitude error changes the local field by R (dtheta x b), hence g . (dtheta x b) = (b x g) . dtheta
    attitude = (by * gz - bz * gy, bz * gx - bx * gz, bx * gy - by * gx)
    return wrap_pi(declination - math.atan2(my, mx)), attitude, (-gx, -gy, -gz), 1


@kernel
def track_field(field, e, s):
    """Update the moving average of the magnetic field, a ``FIELD`` record."""
    mx, my, mz = rotate(e.q, s.mag[0] - e.mag_bias[0], s.mag[1] - e.mag_bias[1], s.mag[2] - e.mag_bias[2])
    field.samples = min(field.samples + 1, _FIELD_SAMPLES)
    field.strength += (math.sqrt(mx * mx + my * my) - field.strength) / field.samples
    field.down += (mz - field.down) / field.samples


@kernel
def fuse_heading(e, s, p, work):
    """Fuse the magnetic heading, unless the field is vertical."""
    innovation, attitude, bias, found = magnetic_heading(e, s, math.radians(p.ekf2_mag_decl))
    if not found:
        return
    e.innovation.yaw = innovation
    e.test_ratio.mag = _fuse_two_blocks(
        e, THETA, attitude, BM, bias, innovation, p.ekf2_head_noise**2, p.ekf2_hdg_gate, work
    )
    if e.test_ratio.mag <= 1.0:
        e.time_heading_fuse_us = s.time_us


@kernel
def yaw_derivative(q):
    """Return the derivatives of the Euler yaw by the attitude error's y and z (by x: 0); zeros near gimbal lock."""
    r00 = 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3])
    r10 = 2.0 * (q[1] * q[2] + q[0] * q[3])
    r01 = 2.0 * (q[1] * q[2] - q[0] * q[3])
    r11 = 1.0 - 2.0 * (q[1] * q[1] + q[3] * q[3])
    r02 = 2.0 * (q[1] * q[3] + q[0] * q[2])
    r12 = 2.0 * (q[2] * q[3] - q[0] * q[1])
    level = r00 * r00 + r10 * r10
    if level < _LEVEL_LIMIT:
        return 0.0, 0.0
    return -(r00 * r12 - r10 * r02) / level, (r00 * r11 - r10 * r01) / level


@kernel
def fuse_yaw(e, innovation, noise_variance, gate, work):
    """Fuse a measured Euler yaw; return its test ratio."""
    hy, hz = yaw_derivative(e.q)
    return _fuse_two_blocks(
        e, THETA, (0.0, hy, hz), VEL, (0.0, 0.0, 0.0), innovation, noise_variance, gate, work
    )  # fmt: skip


@kernel
def body_velocity(e):
    """Return the estimated velocity in the body frame, m/s."""
    return rotate((e.q[0], -e.q[1], -e.q[2], -e.q[3]), e.velocity[0], e.velocity[1], e.velocity[2])


@kernel
def flow_prediction(e, hagl):
    """Return the predicted flow of a downward sensor without the part caused by rotation, and its Jacobian.

    Signs as in OPTICAL_FLOW_RAD: x = -v_y / range, y = v_x / range, with the velocity in the body frame and the range
    along body z to level ground ``hagl`` (m) below: range = hagl / R33.

    Returns:
        The flow (x, y) in rad/s; the derivatives of x with respect to attitude error and velocity (3-tuples); those of
        y.
    """
    q = e.q
    vx, vy, vz = body_velocity(e)
    r20 = 2.0 * (q[1] * q[3] - q[0] * q[2])
    r21 = 2.0 * (q[2] * q[3] + q[0] * q[1])
    r22 = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])
    near = r22 / hagl  # 1 / range
    # v_body changes by v_body x dtheta, R33 by R31 dtheta_y - R32 dtheta_x
    dx, dy = -r21 / hagl, r20 / hagl
    x_attitude = (-vz * near - vy * dx, -vy * dy, vx * near)
    y_attitude = (vx * dx, -vz * near + vx * dy, vy * near)
    # the rows of R' are the body axes in the local frame
    c0 = rotate(q, 1.0, 0.0, 0.0)
    c1 = rotate(q, 0.0, 1.0, 0.0)
    x_velocity = (-near * c1[0], -near * c1[1], -near * c1[2])
    y_velocity = (near * c0[0], near * c0[1], near * c0[2])
    return (-vy * near, vx * near), x_attitude, x_velocity, y_attitude, y_velocity


@kernel
def fuse_flow(e, x, y, hagl, noise_variance, gate, work):
    """Fuse a rotation-compensated flow (rad/s, signs as in ``flow_prediction``); return the larger test ratio."""
    predicted, attitude, velocity, _, _ = flow_prediction(e, hagl)
    e.innovation.flow[0] = x - predicted[0]
    first = _fuse_two_blocks(e, THETA, attitude, VEL, velocity, e.innovation.flow[0], noise_variance, gate, work)
    predicted, _, _, attitude, velocity = flow_prediction(e, hagl)
    e.innovation.flow[1] = y - predicted[1]
    second = _fuse_two_blocks(e, THETA, attitude, VEL, velocity, e.innovation.flow[1], noise_variance, gate, work)
    return max(first, second)


@kernel
def _reset_covariance(e, index, count, variance):
    """Set the variance of ``count`` error states from ``index`` on, and clear their correlations."""
    for i in range(index, index + count):
        for j in range(N_STATES):
            e.P[i, j] = 0.0
            e.P[j, i] = 0.0
        e.P[i, i] = variance


@kernel
def reset_position(e, north, east, variance):
    """Reset the horizontal position (m, local) and its variance (m^2)."""
    e.shifts.xy[0], e.shifts.xy[1] = north - e.position[0], east - e.position[1]
    e.position[0], e.position[1] = north, east
    e.last_position[0], e.last_position[1] = north, east
    _reset_covariance(e, POS, 2, variance)
    if e.located:
        e.resets.xy += 1
        e.resets.any += 1


@kernel
def reset_velocity(e, north, east, variance):
    """Reset the horizontal velocity (m/s, local) and its variance (m^2/s^2)."""
    e.shifts.vxy[0], e.shifts.vxy[1] = north - e.velocity[0], east - e.velocity[1]
    e.velocity[0], e.velocity[1] = north, east
    _reset_covariance(e, VEL, 2, variance)
    if e.located:
        e.resets.vxy += 1
        e.resets.any += 1


@kernel
def reset_height(e, down, variance):
    """Reset the vertical position (m, down) and its variance (m^2), keeping the height above terrain."""
    e.shifts.z = down - e.position[2]
    e.position[2] = down
    e.terrain += e.shifts.z
    _reset_covariance(e, POS + 2, 1, variance)
    if e.altitude_valid:
        e.resets.z += 1
        e.resets.any += 1


@kernel
def reset_vertical_velocity(e, down, variance):
    """Reset the vertical velocity (m/s, down) and its variance (m^2/s^2)."""
    e.shifts.vz = down - e.velocity[2]
    e.velocity[2] = down
    _reset_covariance(e, VEL + 2, 1, variance)
    if e.located:
        e.resets.vz += 1
        e.resets.any += 1


@kernel
def set_yaw_variance(e, variance):
    """Set the variance (rad^2) of the attitude error about the local vertical, and clear its correlations."""
    vx, vy, vz = rotate((e.q[0], -e.q[1], -e.q[2], -e.q[3]), 0.0, 0.0, 1.0)
    for i in range(N_STATES):
        along = vx * e.P[0, i] + vy * e.P[1, i] + vz * e.P[2, i]
        e.P[0, i] -= vx * along
        e.P[1, i] -= vy * along
        e.P[2, i] -= vz * along
    for i in range(N_STATES):
        along = vx * e.P[i, 0] + vy * e.P[i, 1] + vz * e.P[i, 2]
        e.P[i, 0] -= vx * along
        e.P[i, 1] -= vy * along
        e.P[i, 2] -= vz * along
    v = (vx, vy, vz)
    for i in range(3):
        for j in range(3):
            e.P[i, j] += v[i] * v[j] * variance
    for i in range(3):  # symmetrise after the two projections
        for j in range(i):
            value = 0.5 * (e.P[i, j] + e.P[j, i])
            e.P[i, j] = value
            e.P[j, i] = value


@kernel
def reset_mag_bias(e, variance):
    """Reset the magnetometer's bias to 0 with ``variance`` (gauss^2)."""
    for i in range(3):
        e.mag_bias[i] = 0.0
    _reset_covariance(e, BM, 3, variance)


@kernel
def reset_yaw(e, turn, variance):
    """Rotate the attitude by ``turn`` (rad) about the local vertical, and set the heading's variance (rad^2)."""
    w, x, y, z = multiply((math.cos(0.5 * turn), 0.0, 0.0, math.sin(0.5 * turn)), e.q)
    e.q[0], e.q[1], e.q[2], e.q[3] = w, x, y, z
    set_yaw_variance(e, variance)
    e.shifts.heading = turn
    e.resets.heading += 1
    e.resets.any += 1


@kernel
def to_origin(e, s, x, y, z, lag):
    """Return what to add to a sensor's position and velocity to obtain those of the body's origin now.

    Parameters EKF2_*_POS_* and EKF2_*_DELAY describe the sensor.

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
