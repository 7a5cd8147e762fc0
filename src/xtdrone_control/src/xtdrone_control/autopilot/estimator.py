"""Error-state extended Kalman filter over IMU, GPS, barometer and magnetometer; one vehicle a call.

The nominal state is attitude, velocity, position and the two IMU biases; the error state is the 15-vector
``(dtheta, dv, dp, dbg, dba)`` with dtheta a rotation vector in the body frame, so that q_true = q * exp(dtheta)
(J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, chapters 5 and 6). The nominal state is
propagated with every IMU sample, the covariance every ``COVARIANCE_PERIOD`` with the increments summed in between, as
PX4's EKF2 does at its own rate; measurements are fused as scalars in sequence, each with an innovation gate. Noise
parameters have the names and meaning of PX4's EKF2.
"""

from __future__ import annotations

import math

from . import geo
from .kernel import kernel
from .rotation import constrain, from_euler, integrate, rotate, wrap_pi
from .state import N_STATES

GRAVITY = 9.80665  # m/s^2
COVARIANCE_PERIOD = 0.012  # s; PX4: EKF2_PREDICT_US = 10 ms, rounded up to whole IMU samples
ALIGNMENT_SAMPLES = 100  # IMU samples averaged at rest before the first attitude
_MIN_MAG_SAMPLES = 5
_THETA, _VEL, _POS, _BG, _BA = 0, 3, 6, 9, 12
_YAW_INIT_STD = 0.1  # rad, from the averaged magnetometer
_TILT_INIT_STD = 0.05  # rad, from the averaged accelerometer

_project = kernel(geo.project)


@kernel
def align(e, s, p):
    """Average IMU and magnetometer at rest; set attitude and covariance once there are enough samples."""
    for i in range(3):
        e.accel_mean[i] += s.accel[i]
    e.samples += 1
    if s.mag_fresh:
        for i in range(3):
            e.mag_mean[i] += s.mag[i]
        e.mag_samples += 1
    if e.samples < ALIGNMENT_SAMPLES or e.mag_samples < _MIN_MAG_SAMPLES:
        return
    ax, ay, az = e.accel_mean[0], e.accel_mean[1], e.accel_mean[2]
    roll = math.atan2(-ay, -az)
    pitch = math.atan2(ax, math.sqrt(ay * ay + az * az))
    level = from_euler(roll, pitch, 0.0)
    mx, my, _ = rotate(level, e.mag_mean[0], e.mag_mean[1], e.mag_mean[2])
    yaw = math.radians(p.ekf2_mag_decl) - math.atan2(my, mx)
    q = from_euler(roll, pitch, yaw)
    for i in range(4):
        e.q[i] = q[i]
    for i in range(N_STATES):
        for j in range(N_STATES):
            e.P[i, j] = 0.0
    for i in range(2):
        e.P[_THETA + i, _THETA + i] = _TILT_INIT_STD**2
    e.P[2, 2] = _YAW_INIT_STD**2
    for i in range(3):
        e.P[_VEL + i, _VEL + i] = p.ekf2_gps_v_noise**2
        e.P[_POS + i, _POS + i] = p.ekf2_gps_p_noise**2
        e.P[_BG + i, _BG + i] = p.ekf2_gbias_init**2
        e.P[_BA + i, _BA + i] = p.ekf2_abias_init**2
    e.initialised = 1


@kernel
def propagate(e, s, p, dt):
    """Advance the nominal state by one IMU sample and the filtered rates that the controllers use."""
    gx = s.gyro[0] - e.gyro_bias[0]
    gy = s.gyro[1] - e.gyro_bias[1]
    gz = s.gyro[2] - e.gyro_bias[2]
    ax = s.accel[0] - e.accel_bias[0]
    ay = s.accel[1] - e.accel_bias[1]
    az = s.accel[2] - e.accel_bias[2]
    # specific force turned at the middle of the step, so that a constant rate brings no bias
    integrate(e.q, 0.5 * gx * dt, 0.5 * gy * dt, 0.5 * gz * dt)
    fx, fy, fz = rotate(e.q, ax, ay, az)
    integrate(e.q, 0.5 * gx * dt, 0.5 * gy * dt, 0.5 * gz * dt)
    fz += GRAVITY
    e.acceleration[0], e.acceleration[1], e.acceleration[2] = fx, fy, fz
    for i in range(3):
        before = e.velocity[i]
        e.velocity[i] = before + e.acceleration[i] * dt
        e.position[i] += 0.5 * (before + e.velocity[i]) * dt
    e.delta_angle[0] += gx * dt
    e.delta_angle[1] += gy * dt
    e.delta_angle[2] += gz * dt
    e.delta_velocity[0] += ax * dt
    e.delta_velocity[1] += ay * dt
    e.delta_velocity[2] += az * dt
    e.since_predict += dt
    _filter_for_control(e, gx, gy, gz, p, dt)


@kernel
def _low_pass(cutoff_hz, dt):
    """Return the gain of a discrete first-order low-pass (PX4's AlphaFilter); 0 Hz switches it off."""
    step = 2.0 * math.pi * cutoff_hz * dt
    return step / (1.0 + step) if cutoff_hz > 0.0 else 1.0


@kernel
def _filter_for_control(e, gx, gy, gz, p, dt):
    rate_gain = _low_pass(p.imu_gyro_cutoff, dt)
    accel_gain = _low_pass(p.imu_dgyro_cutoff, dt)
    velocity_gain = _low_pass(p.mpc_veld_lp, dt)
    raw = (gx, gy, gz)
    for i in range(3):
        before = e.rates[i]
        e.rates[i] += rate_gain * (raw[i] - before)
        e.angular_acceleration[i] += accel_gain * ((e.rates[i] - before) / dt - e.angular_acceleration[i])
        e.velocity_dot[i] += velocity_gain * (e.acceleration[i] - e.velocity_dot[i])


@kernel
def predict_covariance(e, p):
    """P <- Phi P Phi' + Q over the increments summed since the last call.

    Phi has identity blocks but for d(theta)/d(theta) = I - [da]x, d(theta)/d(bg) = -I dt, d(v)/d(theta) = -R [dv]x,
    d(v)/d(ba) = -R dt, d(p)/d(v) = I dt; the products below visit only those blocks.
    """
    dt = e.since_predict
    P = e.P
    dax, day, daz = e.delta_angle[0], e.delta_angle[1], e.delta_angle[2]
    dvx, dvy, dvz = e.delta_velocity[0], e.delta_velocity[1], e.delta_velocity[2]
    # columns of R, and of M = -R [dv]x = R [-dv]x
    r00, r10, r20 = rotate(e.q, 1.0, 0.0, 0.0)
    r01, r11, r21 = rotate(e.q, 0.0, 1.0, 0.0)
    r02, r12, r22 = rotate(e.q, 0.0, 0.0, 1.0)
    m00, m10, m20 = rotate(e.q, 0.0, -dvz, dvy)
    m01, m11, m21 = rotate(e.q, dvz, 0.0, -dvx)
    m02, m12, m22 = rotate(e.q, -dvy, dvx, 0.0)

    # rows: P <- Phi P, position first because it uses the old velocity, velocity before attitude likewise
    for j in range(N_STATES):
        t0, t1, t2 = P[0, j], P[1, j], P[2, j]
        P[6, j] += dt * P[3, j]
        P[7, j] += dt * P[4, j]
        P[8, j] += dt * P[5, j]
        b0, b1, b2 = P[12, j], P[13, j], P[14, j]
        P[3, j] += m00 * t0 + m01 * t1 + m02 * t2 - dt * (r00 * b0 + r01 * b1 + r02 * b2)
        P[4, j] += m10 * t0 + m11 * t1 + m12 * t2 - dt * (r10 * b0 + r11 * b1 + r12 * b2)
        P[5, j] += m20 * t0 + m21 * t1 + m22 * t2 - dt * (r20 * b0 + r21 * b1 + r22 * b2)
        P[0, j] = t0 + daz * t1 - day * t2 - dt * P[9, j]
        P[1, j] = t1 - daz * t0 + dax * t2 - dt * P[10, j]
        P[2, j] = t2 + day * t0 - dax * t1 - dt * P[11, j]
    # columns: P <- P Phi'
    for i in range(N_STATES):
        t0, t1, t2 = P[i, 0], P[i, 1], P[i, 2]
        P[i, 6] += dt * P[i, 3]
        P[i, 7] += dt * P[i, 4]
        P[i, 8] += dt * P[i, 5]
        b0, b1, b2 = P[i, 12], P[i, 13], P[i, 14]
        P[i, 3] += m00 * t0 + m01 * t1 + m02 * t2 - dt * (r00 * b0 + r01 * b1 + r02 * b2)
        P[i, 4] += m10 * t0 + m11 * t1 + m12 * t2 - dt * (r10 * b0 + r11 * b1 + r12 * b2)
        P[i, 5] += m20 * t0 + m21 * t1 + m22 * t2 - dt * (r20 * b0 + r21 * b1 + r22 * b2)
        P[i, 0] = t0 + daz * t1 - day * t2 - dt * P[i, 9]
        P[i, 1] = t1 - daz * t0 + dax * t2 - dt * P[i, 10]
        P[i, 2] = t2 + day * t0 - dax * t1 - dt * P[i, 11]

    angle_variance = (p.ekf2_gyr_noise * dt) ** 2
    velocity_variance = (p.ekf2_acc_noise * dt) ** 2
    gyro_bias_variance = (p.ekf2_gyr_b_noise * dt) ** 2
    accel_bias_variance = (p.ekf2_acc_b_noise * dt) ** 2
    for i in range(3):
        P[_THETA + i, _THETA + i] += angle_variance
        P[_VEL + i, _VEL + i] += velocity_variance
        P[_BG + i, _BG + i] += gyro_bias_variance
        P[_BA + i, _BA + i] += accel_bias_variance
    for i in range(3):
        e.delta_angle[i] = 0.0
        e.delta_velocity[i] = 0.0
    e.since_predict = 0.0


@kernel
def _correct(e, gain, row, innovation, variance):
    """Kalman update by a scalar: ``row`` = H P (15,), ``variance`` = H P H' + R; ``gain`` (15,) is scratch."""
    for i in range(N_STATES):
        gain[i] = row[i] / variance
    for i in range(N_STATES):
        for j in range(i + 1):
            value = e.P[i, j] - gain[i] * row[j]
            e.P[i, j] = value
            e.P[j, i] = value
    for i in range(N_STATES):
        gain[i] *= innovation
    integrate(e.q, gain[0], gain[1], gain[2])
    for i in range(3):
        e.velocity[i] += gain[_VEL + i]
        e.position[i] += gain[_POS + i]
        e.gyro_bias[i] += gain[_BG + i]
        e.accel_bias[i] += gain[_BA + i]


@kernel
def fuse_state(e, index, innovation, noise_variance, gate, work):
    """Fuse a direct measurement of error state ``index``; return its innovation test ratio (fused when <= 1)."""
    variance = e.P[index, index] + noise_variance
    ratio = innovation * innovation / (gate * gate * variance)
    if ratio > 1.0:
        return ratio
    for i in range(N_STATES):
        work[1, i] = e.P[index, i]
    _correct(e, work[0], work[1], innovation, variance)
    return ratio


@kernel
def fuse_heading(e, s, p, work):
    """Fuse the heading that the magnetometer shows once it is turned level with the present tilt."""
    q = e.q
    r00 = 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3])
    r10 = 2.0 * (q[1] * q[2] + q[0] * q[3])
    r01 = 2.0 * (q[1] * q[2] - q[0] * q[3])
    r11 = 1.0 - 2.0 * (q[1] * q[1] + q[3] * q[3])
    r02 = 2.0 * (q[1] * q[3] + q[0] * q[2])
    r12 = 2.0 * (q[2] * q[3] - q[0] * q[1])
    horizontal = r00 * r00 + r10 * r10
    if horizontal < 1e-4:
        return  # nose straight up or down: no heading
    # the field in the local frame by the present attitude points to the declination when the heading is right
    mx, my, _ = rotate(q, s.mag[0], s.mag[1], s.mag[2])
    innovation = wrap_pi(math.radians(p.ekf2_mag_decl) - math.atan2(my, mx))
    hy = -(r00 * r12 - r10 * r02) / horizontal
    hz = (r00 * r11 - r10 * r01) / horizontal
    for i in range(N_STATES):
        work[1, i] = hy * e.P[1, i] + hz * e.P[2, i]
    variance = hy * work[1, 1] + hz * work[1, 2] + p.ekf2_head_noise**2
    e.innov_yaw = innovation
    e.test_ratio_mag = innovation * innovation / (p.ekf2_hdg_gate**2 * variance)
    if e.test_ratio_mag <= 1.0:
        _correct(e, work[0], work[1], innovation, variance)


@kernel
def fuse_gps(e, s, p, work):
    """Fuse a GPS fix: position and velocity; the first one sets them, and the origin if none is given."""
    e.time_last_gps_us = s.time_us
    if s.gps_fix < 3 or s.gps_eph > p.ekf2_req_eph or s.gps_epv > p.ekf2_req_epv:
        return
    if not e.origin_set:
        e.origin_lat, e.origin_lon, e.origin_alt = s.gps_lat, s.gps_lon, s.gps_alt
        e.origin_set = 1
    north, east = _project(s.gps_lat, s.gps_lon, e.origin_lat, e.origin_lon)
    measured = (north, east, e.origin_alt - s.gps_alt)
    timed_out = s.time_us - e.time_last_pos_fuse_us > p.ekf2_noaid_tout
    if not e.position_valid or timed_out:
        _reset_to(e, measured, s, p)
        return
    horizontal = max(p.ekf2_gps_p_noise, s.gps_eph) ** 2
    vertical = max(1.5 * p.ekf2_gps_p_noise, s.gps_epv) ** 2
    speed = max(p.ekf2_gps_v_noise, s.gps_speed_accuracy) ** 2
    e.test_ratio_vel = 0.0
    e.test_ratio_pos = 0.0
    for i in range(3):
        e.innov_vel[i] = s.gps_vel[i] - e.velocity[i]
        ratio = fuse_state(e, _VEL + i, e.innov_vel[i], speed, p.ekf2_gps_v_gate, work)
        e.test_ratio_vel = max(e.test_ratio_vel, ratio)
    for i in range(2):
        e.innov_pos[i] = measured[i] - e.position[i]
        ratio = fuse_state(e, _POS + i, e.innov_pos[i], horizontal, p.ekf2_gps_p_gate, work)
        e.test_ratio_pos = max(e.test_ratio_pos, ratio)
    e.innov_pos[2] = measured[2] - e.position[2]
    fuse_state(e, _POS + 2, e.innov_pos[2], vertical, p.ekf2_gps_p_gate, work)
    if e.test_ratio_pos <= 1.0:
        e.time_last_pos_fuse_us = s.time_us


@kernel
def _reset_to(e, measured, s, p):
    """Set position and velocity to a GPS fix and forget their correlations with the rest."""
    first = not e.position_valid
    for i in range(3):
        e.position[i] = measured[i]
        e.velocity[i] = s.gps_vel[i]
        for j in range(N_STATES):
            e.P[_VEL + i, j] = 0.0
            e.P[j, _VEL + i] = 0.0
            e.P[_POS + i, j] = 0.0
            e.P[j, _POS + i] = 0.0
    for i in range(3):
        e.P[_VEL + i, _VEL + i] = max(p.ekf2_gps_v_noise, s.gps_speed_accuracy) ** 2
        e.P[_POS + i, _POS + i] = max(p.ekf2_gps_p_noise, s.gps_eph) ** 2
    e.position_valid = 1
    e.altitude_valid = 1
    e.time_last_pos_fuse_us = s.time_us
    e.baro_offset = s.baro_alt - s.gps_alt
    if not first:
        e.reset_counter += 1


@kernel
def fuse_barometer(e, s, p, work):
    """Fuse the pressure altitude, its offset against GPS altitude followed slowly while GPS is there (EKF2_HGT_REF)."""
    if not e.altitude_valid:
        return
    measured = e.origin_alt - (s.baro_alt - e.baro_offset)
    e.innov_hgt = measured - e.position[2]
    gate = p.ekf2_baro_gate
    e.test_ratio_hgt = fuse_state(e, _POS + 2, e.innov_hgt, p.ekf2_baro_noise**2, gate, work)
    if s.time_us - e.time_last_gps_us < 1_000_000:
        e.baro_offset += 0.01 * constrain(-e.innov_hgt, -1.0, 1.0)


@kernel
def update(e, s, p, dt, work):
    """Run the filter of one vehicle for one IMU sample.

    Args:
        e: ``ESTIMATOR`` record.
        s: ``SENSORS`` record with this step's samples.
        p: ``PARAMS`` record.
        dt: s since the last sample.
        work: (2, 15) scratch.
    """
    if not e.initialised:
        align(e, s, p)
        return
    propagate(e, s, p, dt)
    if e.since_predict >= COVARIANCE_PERIOD - 1e-9:
        predict_covariance(e, p)
    if s.mag_fresh:
        fuse_heading(e, s, p, work)
    if s.gps_fresh:
        fuse_gps(e, s, p, work)
    if s.baro_fresh:
        fuse_barometer(e, s, p, work)
    if e.position_valid and s.time_us - e.time_last_pos_fuse_us > p.ekf2_noaid_tout:
        e.position_valid = 0
    limit = p.ekf2_abl_lim
    for i in range(3):
        e.accel_bias[i] = constrain(e.accel_bias[i], -limit, limit)
