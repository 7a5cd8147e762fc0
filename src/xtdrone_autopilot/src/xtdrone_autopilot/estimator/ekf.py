"""Error-state extended Kalman filter over the IMU and the aiding sensors, for one vehicle per call.

The nominal state is attitude, velocity, position and the biases of gyroscope, accelerometer and magnetometer; the error
state is the 18-vector ``(dtheta, dv, dp, dbg, dba, dbm)`` with dtheta a rotation vector in the body frame, so that
q_true = q * exp(dtheta) (J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, chapters 5 and 6).
The nominal state is propagated with every IMU sample, the covariance every ``COVARIANCE_PERIOD`` with the accumulated
increments, as in PX4's EKF2. Measurements are fused sequentially as scalars, each with an innovation gate: ``fusion``
has the measurement updates. Each source's module in ``aiding`` starts and stops its fusion, checks its samples, and
resets the state to it after a long rejection; ``source_timeouts`` stops sources that are silent.

Parameters have the names and meaning of PX4 v1.14's EKF2. Differences: measurements are fused on arrival, extrapolated
over EKF2_*_DELAY beyond the defaults, by which the simulated sensors are late; the state is that of the body's origin,
not of the inertial sensor; one filter runs per vehicle, not one per IMU; wind, drag, sideslip and airspeed are not
modelled; the magnetometer is fused as a heading with an estimated bias, not as three axes; GPS drift on the ground is
not checked (EKF2_GPS_CHECK bits 32 to 256).
"""

from __future__ import annotations

import math

from xtdrone_autopilot.estimator.aiding.sources.external_vision_control import process_vision
from xtdrone_autopilot.estimator.aiding.sources.flow_control import process_flow
from xtdrone_autopilot.estimator.aiding.sources.gps_control import process_gps
from xtdrone_autopilot.estimator.aiding.sources.height_control import process_baro
from xtdrone_autopilot.estimator.aiding.sources.mag_control import process_mag
from xtdrone_autopilot.estimator.aiding.sources.range_control import process_range
from xtdrone_autopilot.estimator.aiding.validity_and_status_flags import update_status
from xtdrone_autopilot.estimator.fusion import BA, BG, BM, POS, THETA, VEL, YAW_UNKNOWN_STD, set_yaw_variance
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import N_STATES
from xtdrone_common.geodesy.projection import GRAVITY
from xtdrone_common.rotation_kernels import assign_unit, constrain, exponential, from_euler, multiply, rotate

COVARIANCE_PERIOD = 0.012  # s; PX4: EKF2_PREDICT_US = 10 ms, rounded up to whole IMU samples
ALIGNMENT_SAMPLES = 100  # IMU samples averaged at rest before the first attitude
_LONGEST_ALIGNMENT = 500  # IMU samples after which alignment ends without a magnetometer
_MIN_MAG_SAMPLES = 5
_GYRO_BIAS, _ACCEL_BIAS = 1, 2  # EKF2_IMU_CTRL
_LEAST_FORCE, _LARGEST_FORCE = 0.8 * GRAVITY, 1.2 * GRAVITY  # m/s^2 of a vehicle at rest (PX4: Ekf::initialiseTilt)
_MOST_ROTATION = math.radians(15.0)  # rad/s, likewise


@kernel
def _add_samples(sums, s):
    for i in range(3):
        sums.accel[i] += s.accel[i]
    sums.samples += 1
    if s.mag_fresh:
        for i in range(3):
            sums.mag[i] += s.mag[i]
        sums.mag_samples += 1


@kernel
def _length(x, y, z):
    return math.sqrt(x * x + y * y + z * z)


@kernel
def _was_at_rest(sums, s):
    """Return whether the mean specific force and the latest sample are those of a vehicle at rest."""
    mean = _length(sums.accel[0], sums.accel[1], sums.accel[2]) / sums.samples
    last = _length(s.accel[0], s.accel[1], s.accel[2])
    if not (_LEAST_FORCE <= mean <= _LARGEST_FORCE and _LEAST_FORCE <= last <= _LARGEST_FORCE):
        return False
    return _length(s.gyro[0], s.gyro[1], s.gyro[2]) <= _MOST_ROTATION


@kernel
def _forget_samples(sums):
    for i in range(3):
        sums.accel[i] = 0.0
        sums.mag[i] = 0.0
    sums.samples = 0
    sums.mag_samples = 0


@kernel
def align(e, s, p):
    """Average IMU and magnetometer samples at rest; initialise attitude and covariance after enough samples.

    If the vehicle has moved meanwhile, for example fallen to the ground, the averaging restarts.
    """
    sums = e.alignment
    _add_samples(sums, s)
    wants_mag = int(p.ekf2_mag_type) != 5
    no_mag = not wants_mag or sums.samples >= _LONGEST_ALIGNMENT
    if sums.samples < ALIGNMENT_SAMPLES or (sums.mag_samples < _MIN_MAG_SAMPLES and not no_mag):
        return
    if not _was_at_rest(sums, s):
        _forget_samples(sums)
        return
    ax, ay, az = sums.accel[0], sums.accel[1], sums.accel[2]
    roll = math.atan2(-ay, -az)
    pitch = math.atan2(ax, math.sqrt(ay * ay + az * az))
    yaw = 0.0
    if wants_mag and sums.mag_samples >= _MIN_MAG_SAMPLES:
        level = from_euler(roll, pitch, 0.0)
        mx, my, mz = rotate(level, sums.mag[0], sums.mag[1], sums.mag[2])
        e.field.samples = sums.mag_samples
        e.field.strength = math.sqrt(mx * mx + my * my) / sums.mag_samples
        e.field.down = mz / sums.mag_samples
        yaw = math.radians(p.ekf2_mag_decl) - math.atan2(my, mx)
        e.heading_aligned = 1
        e.time_heading_fuse_us = s.time_us
    q = from_euler(roll, pitch, yaw)
    for i in range(4):
        e.q[i] = q[i]
    _first_covariance(e, p)
    e.initialised = e.attitude_valid = 1
    e.time_aligned_us = s.time_us


@kernel
def _first_covariance(e, p):
    """Initialise the covariance after the alignment.

    An accelerometer bias b tilts the aligned attitude by (d x b) / g^2, where d is the specific force at rest in the
    body frame. Tilt error and bias are therefore correlated from the start.
    """
    for i in range(N_STATES):
        for j in range(N_STATES):
            e.P[i, j] = 0.0
    for i in range(3):
        e.P[VEL + i, VEL + i] = p.ekf2_gps_v_noise**2
        e.P[POS + i, POS + i] = p.ekf2_gps_p_noise**2
        e.P[BG + i, BG + i] = p.ekf2_gbias_init**2
        e.P[BA + i, BA + i] = p.ekf2_abias_init**2
        e.P[BM + i, BM + i] = p.ekf2_mag_noise**2
        e.P[THETA + i, THETA + i] = p.ekf2_angerr_init**2
    set_yaw_variance(e, YAW_UNKNOWN_STD**2)
    dx, dy, dz = rotate((e.q[0], -e.q[1], -e.q[2], -e.q[3]), 0.0, 0.0, -1.0)
    g = ((0.0, -dz, dy), (dz, 0.0, -dx), (-dy, dx, 0.0))  # [d]x, d of length 1
    variance = p.ekf2_abias_init**2
    for i in range(3):
        for j in range(3):
            e.P[THETA + i, BA + j] = e.P[BA + j, THETA + i] = g[i][j] / GRAVITY * variance
            along = g[i][0] * g[j][0] + g[i][1] * g[j][1] + g[i][2] * g[j][2]
            e.P[THETA + i, THETA + j] += along * variance / GRAVITY**2


@kernel
def _force_by_lever(e, p, wx, wy, wz):
    """Return the specific force (3-tuple, body) that an inertial sensor away from the origin measures by rotation."""
    x, y, z = p.ekf2_imu_pos_x, p.ekf2_imu_pos_y, p.ekf2_imu_pos_z
    ux, uy, uz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
    dx, dy, dz = e.angular_acceleration[0], e.angular_acceleration[1], e.angular_acceleration[2]
    return (
        dy * z - dz * y + wy * uz - wz * uy,
        dz * x - dx * z + wz * ux - wx * uz,
        dx * y - dy * x + wx * uy - wy * ux,
    )


@kernel
def propagate(e, s, p, dt):
    """Propagate the nominal state by one IMU sample."""
    gx = s.gyro[0] - e.gyro_bias[0]
    gy = s.gyro[1] - e.gyro_bias[1]
    gz = s.gyro[2] - e.gyro_bias[2]
    lx, ly, lz = _force_by_lever(e, p, gx, gy, gz)
    ax = s.accel[0] - e.accel_bias[0] - lx
    ay = s.accel[1] - e.accel_bias[1] - ly
    az = s.accel[2] - e.accel_bias[2] - lz
    # rotate the specific force by the mid-step attitude, so that a constant rate causes no bias
    half = exponential(0.5 * gx * dt, 0.5 * gy * dt, 0.5 * gz * dt)
    middle = multiply(e.q, half)
    fx, fy, fz = rotate(middle, ax, ay, az)
    assign_unit(e.q, multiply(middle, half))
    fz += GRAVITY
    e.acceleration[0], e.acceleration[1], e.acceleration[2] = fx, fy, fz
    for i in range(3):
        before = e.velocity[i]
        e.velocity[i] = before + e.acceleration[i] * dt
        e.position[i] += 0.5 * (before + e.velocity[i]) * dt
    _accumulate(e.increments, (gx, gy, gz), (ax, ay, az), dt)


@kernel
def _accumulate(increments, rates, force, dt):
    for i in range(3):
        increments.angle[i] += rates[i] * dt
        increments.velocity[i] += force[i] * dt
    increments.time += dt


@kernel
def predict_covariance(e, p):
    """Update P <- Phi P Phi' + Q over the increments accumulated since the last call.

    Phi is the identity except for d(theta)/d(theta) = I - [da]x, d(theta)/d(bg) = -I dt, d(v)/d(theta) = -R [dv]x,
    d(v)/d(ba) = -R dt, d(p)/d(v) = I dt; the products below use only those blocks.
    """
    increments = e.increments
    dt = increments.time
    P = e.P
    dax, day, daz = increments.angle[0], increments.angle[1], increments.angle[2]
    dvx, dvy, dvz = increments.velocity[0], increments.velocity[1], increments.velocity[2]
    # columns of R and of M = -R [dv]x = R [-dv]x
    r00, r10, r20 = rotate(e.q, 1.0, 0.0, 0.0)
    r01, r11, r21 = rotate(e.q, 0.0, 1.0, 0.0)
    r02, r12, r22 = rotate(e.q, 0.0, 0.0, 1.0)
    m00, m10, m20 = rotate(e.q, 0.0, -dvz, dvy)
    m01, m11, m21 = rotate(e.q, dvz, 0.0, -dvx)
    m02, m12, m22 = rotate(e.q, -dvy, dvx, 0.0)

    # rows: P <- Phi P; position first, as it needs the old velocity, and velocity before attitude likewise
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
    # columns: P <- P Phi'; Phi does not change the biases, whose rows follow from the symmetry of P
    for i in range(BG):
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
    for i in range(BG, N_STATES):
        for j in range(BG):
            P[i, j] = P[j, i]

    angle_variance = (p.ekf2_gyr_noise * dt) ** 2
    velocity_variance = (p.ekf2_acc_noise * dt) ** 2
    gyro_bias_variance = (p.ekf2_gyr_b_noise * dt) ** 2
    accel_bias_variance = (p.ekf2_acc_b_noise * dt) ** 2
    mag_bias_variance = (p.ekf2_mag_b_noise * dt) ** 2
    for i in range(3):
        P[THETA + i, THETA + i] += angle_variance
        P[VEL + i, VEL + i] += velocity_variance
        P[BG + i, BG + i] += gyro_bias_variance
        P[BA + i, BA + i] += accel_bias_variance
        P[BM + i, BM + i] += mag_bias_variance
    for i in range(3):
        increments.angle[i] = 0.0
        increments.velocity[i] = 0.0
    increments.time = 0.0


@kernel
def _limit_biases(e, p):
    for i in range(3):
        e.accel_bias[i] = constrain(e.accel_bias[i], -p.ekf2_abl_lim, p.ekf2_abl_lim)
        e.gyro_bias[i] = constrain(e.gyro_bias[i], -p.ekf2_gyr_b_lim, p.ekf2_gyr_b_lim)
    estimated = int(p.ekf2_imu_ctrl)
    if not estimated & _GYRO_BIAS:
        _exclude(e.gyro_bias, e.P, BG)
    if not estimated & _ACCEL_BIAS:
        _exclude(e.accel_bias, e.P, BA)


@kernel
def _exclude(bias, P, first):
    """Remove a bias from the estimate: it is 0, and known."""
    for i in range(3):
        bias[i] = 0.0
        for j in range(N_STATES):
            P[first + i, j] = P[j, first + i] = 0.0


@kernel
def update(e, s, p, dt, work):
    """Advance the filter of one vehicle by one step.

    Args:
        e: ``ESTIMATOR`` record.
        s: ``SENSORS`` record with this step's samples; its fresh flags of flow, range and vision are cleared.
        p: ``PARAMS`` record.
        dt: time since the last IMU sample, s.
        work: (2, N_STATES) scratch.
    """
    if not s.imu_missing:
        e.time_imu_us = s.time_us
        if e.initialised:
            propagate(e, s, p, dt)
            if e.increments.time >= COVARIANCE_PERIOD - 1e-9:
                predict_covariance(e, p)
        else:
            align(e, s, p)
    if e.initialised:
        _fuse_sources(e, s, p, work)
        _limit_biases(e, p)
        update_status(e, s, p, work)
    s.flow_fresh = s.range_fresh = s.vision_fresh = 0


_MAG_PERIOD_US = 60_000  # PX4: SENS_MAG_RATE 15 Hz, rounded to the magnetometer's 50 Hz
_BARO_PERIOD_US = 50_000  # PX4: SENS_BARO_RATE 20 Hz


@kernel
def _fuse_sources(e, s, p, work):
    """Process every fresh sample of this step."""
    if s.mag_fresh and s.time_us - e.time_mag_us >= _MAG_PERIOD_US:
        process_mag(e, s, p, work)
    if s.gps_fresh:
        process_gps(e, s, p, work)
    if s.baro_fresh and s.time_us - e.time_baro_us >= _BARO_PERIOD_US:
        process_baro(e, s, p, work)
    if s.vision_fresh:
        process_vision(e, s, p, work)
    if s.range_fresh:
        process_range(e, s, p, work)
    if s.flow_fresh:
        process_flow(e, s, p, work)
