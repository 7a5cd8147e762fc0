"""Aiding control of the estimator: start, stop, check, time out and reset each source, and update the validity flags.

After PX4 v1.14's EKF2 (gps_control, gps_checks, ev_*_control, optical_flow_control, range_height_control,
baro_height_control, mag_control, fake_pos_control, ekf_helper). EKF2_HGT_REF selects the height reference. Every other
height source tracks the reference with an estimated offset and replaces it, keeping that offset, when the reference
times out. GPS fusion needs a heading aligned with north. Vision in a frame that is not aligned with north (VISION_FRD)
also sets the heading; the magnetometer and GPS are then not used.
"""

from __future__ import annotations

import math

from xtdrone_control.autopilot.estimator.fusion import (
    POS,
    VEL,
    YAW_UNKNOWN_STD,
    fuse_flow,
    fuse_heading,
    fuse_state,
    fuse_yaw,
    magnetic_heading,
    reset_height,
    reset_mag_bias,
    reset_position,
    reset_velocity,
    reset_vertical_velocity,
    reset_yaw,
    track_field,
)
from xtdrone_control.autopilot.state import (
    HEIGHT_BARO,
    HEIGHT_GPS,
    HEIGHT_RANGE,
    HEIGHT_VISION,
    N_STATES,
    VISION_BODY,
    VISION_FRD,
    VISION_NED,
)
from xtdrone_control.geodesy import geo
from xtdrone_control.kernel import kernel
from xtdrone_control.rotation_kernels import constrain, multiply, rotate, wrap_pi, yaw_of

_STATUS_PERIOD_US = 40_000
_AIDING_US = 1_000_000  # without aiding for longer: dead reckoning (PX4: no_aid_timeout_max)
_RESET_US = 7_000_000  # a source rejected for longer resets the state (PX4: reset_timeout_max)
_HEIGHT_RESET_US = 5_000_000  # PX4: hgt_fusion_timeout_max
_GPS_STOP_US = 10_000_000  # GPS timeout; _SENSOR_STOP_US with another horizontal source
_VISION_STOP_US = 400_000  # PX4: twice EV_MAX_INTERVAL
_SENSOR_STOP_US = 1_000_000
_IMU_STOP_US = 200_000
_MAG_PERIOD_US = 60_000  # PX4: SENS_MAG_RATE 15 Hz, rounded to the magnetometer's 50 Hz
_MAG_START_US = 1_000_000  # required duration of an undisturbed field (PX4: min_mag_health_time)
_BARO_PERIOD_US = 50_000  # PX4: SENS_BARO_RATE 20 Hz
_BARO_START_US = 1_000_000  # time for which the barometer waits for the height reference
_HOLD_PERIOD_US = 200_000  # PX4: fake position at 5 Hz
_FIELD_STRENGTH, _FIELD_TOLERANCE = 0.45, 0.25  # gauss; PX4's average over the Earth
_OFFSET_GAIN = 0.02  # share of each innovation added to a source's offset
_LEAST_TERRAIN_VARIANCE = 1e-4  # m^2
_TERRAIN_RATE = 0.01  # s, PX4's filter period, for which EKF2_TERR_NOISE is defined
_LEVEL_COSINE = 0.7  # of the largest tilt at which range and flow are fused (PX4: 45 deg)
_HEADING_LIMIT = 0.3  # rad, largest 1 sigma of a good heading

# EKF2_GPS_CHECK
_CHECK_SATELLITES, _CHECK_PDOP, _CHECK_EPH, _CHECK_EPV, _CHECK_SPEED = 1, 2, 4, 8, 16
# EKF2_GPS_CTRL
_GPS_POSITION, _GPS_ALTITUDE, _GPS_VELOCITY = 1, 2, 4
# EKF2_EV_CTRL
_EV_POSITION, _EV_HEIGHT, _EV_VELOCITY, _EV_YAW = 1, 2, 4, 8
# EKF2_MAG_TYPE
_MAG_NONE, _MAG_INIT = 5, 6

# ESTIMATOR_STATUS_FLAGS
_ATTITUDE, _VELOCITY_XY, _VELOCITY_Z, _POSITION_RELATIVE, _POSITION_ABSOLUTE, _HEIGHT = 1, 2, 4, 8, 16, 32
_HEIGHT_OVER_GROUND, _CONSTANT_POSITION, _PREDICTED_RELATIVE, _PREDICTED_ABSOLUTE = 64, 128, 256, 512
_GPS_GLITCH = 1024

FAULT_NOT_FINITE, FAULT_NO_IMU, FAULT_MAGNETIC = 1, 2, 4

_project = kernel(geo.project)
_reproject = kernel(geo.reproject)


@kernel
def update_imu_time(e, s):
    """Store the time of this step's IMU sample; return whether there is one."""
    if s.imu_missing:
        return False
    e.time_imu_us = s.time_us
    return True


@kernel
def _is_recent(now_us, then_us, limit_us):
    """Return whether ``then_us`` is set (not 0) and at most ``limit_us`` before ``now_us``."""
    return then_us > 0 and now_us - then_us <= limit_us


@kernel
def fuse_sources(e, s, p, work):
    """Process every fresh sample of this step."""
    if s.mag_fresh and s.time_us - e.time_mag_us >= _MAG_PERIOD_US:
        _process_mag(e, s, p, work)
    if s.gps_fresh:
        _process_gps(e, s, p, work)
    if s.baro_fresh and s.time_us - e.time_baro_us >= _BARO_PERIOD_US:
        _process_baro(e, s, p, work)
    if s.vision_fresh:
        _process_vision(e, s, p, work)
    if s.range_fresh:
        _process_range(e, s, p, work)
    if s.flow_fresh:
        _process_flow(e, s, p, work)


# magnetometer


@kernel
def _process_mag(e, s, p, work):
    e.time_mag_us = s.time_us
    if not e.in_air:
        e.mag_fault = 0
    if not _mag_usable(e, s, p):
        e.mag_used = 0
        e.test_ratio.mag = 0.0
        return
    track_field(e.field, e, s)
    if not e.heading_aligned:
        e.mag_resets = 1
        _reset_heading_to_mag(e, s, p, work)
        return
    if not e.mag_used:
        e.mag_used = e.mag_resets = 1
        e.time_heading_fuse_us = s.time_us
    fuse_heading(e, s, p, work)
    if not _is_recent(s.time_us, e.time_heading_fuse_us, _RESET_US):
        _recover_mag(e, s, p, work)


@kernel
def _mag_usable(e, s, p):
    """Update ``mag_good``; return whether the magnetic heading is enabled and plausible."""
    strength = math.sqrt(s.mag[0] ** 2 + s.mag[1] ** 2 + s.mag[2] ** 2)
    disturbed = abs(strength - _FIELD_STRENGTH) > _FIELD_TOLERANCE
    if disturbed:
        e.time_mag_disturbed_us = s.time_us
    e.mag_good = not disturbed and not e.mag_fault
    kind = int(p.ekf2_mag_type)
    rejected = int(p.ekf2_mag_check) & 1 and _is_recent(s.time_us, e.time_mag_disturbed_us, _MAG_START_US)
    first_only = kind == _MAG_INIT and e.heading_aligned
    return not (kind == _MAG_NONE or rejected or first_only or e.mag_fault or e.vision_yaw_used)


@kernel
def _recover_mag(e, s, p, work):
    """Reset the heading and the bias to a magnetometer that has been rejected for ``_RESET_US``.

    In the air this happens once; a magnetometer that is rejected again is declared faulty until landing, as in PX4's
    mag_heading_control.
    """
    if e.in_air and not e.mag_resets:
        e.mag_fault = 1
        e.mag_used = e.mag_good = 0
        e.test_ratio.mag = 0.0
        return
    reset_mag_bias(e, p.ekf2_mag_noise**2)
    _reset_heading_to_mag(e, s, p, work)
    if e.in_air:
        e.mag_resets -= 1


@kernel
def _reset_heading_to_mag(e, s, p, work):
    """Reset the heading to the magnetic heading.

    The heading is first declared unknown and then measured. Its variance therefore contains the errors of the sample
    and of the bias, with the right correlations to the other states.
    """
    innovation, _, _, found = magnetic_heading(e, s, math.radians(p.ekf2_mag_decl))
    if not found:
        return
    reset_yaw(e, innovation, YAW_UNKNOWN_STD**2)
    fuse_heading(e, s, p, work)
    e.heading_aligned = e.mag_used = 1
    e.time_heading_fuse_us = s.time_us


# GPS


@kernel
def _check_gps(e, s, p):
    """Update ``gps_good``: whether fixes have passed all enabled checks for EKF2_REQ_GPS_H."""
    bits = int(p.ekf2_gps_check)
    fails = s.gps_fix < 3
    fails = fails or (bits & _CHECK_SATELLITES and s.gps_satellites < p.ekf2_req_nsats)
    pdop = math.sqrt(s.gps_hdop**2 + s.gps_vdop**2)
    fails = fails or (bits & _CHECK_PDOP and pdop > p.ekf2_req_pdop)
    fails = fails or (bits & _CHECK_EPH and s.gps_eph > p.ekf2_req_eph)
    fails = fails or (bits & _CHECK_EPV and s.gps_epv > p.ekf2_req_epv)
    fails = fails or (bits & _CHECK_SPEED and s.gps_speed_accuracy > p.ekf2_req_sacc)
    # the first fix starts the hold time, as the start of the filter does in PX4
    if fails or e.time_gps_fail_us == 0:
        e.time_gps_fail_us = s.time_us
    e.gps_good = s.time_us - e.time_gps_fail_us >= p.ekf2_req_gps_h * 1e6


@kernel
def _other_horizontal_aiding(e):
    """Return whether a source other than GPS aids the horizontal state."""
    return e.vision_position_used or e.vision_velocity_used or e.flow_used


@kernel
def _process_gps(e, s, p, work):
    e.time_last_gps_us = s.time_us
    _check_gps(e, s, p)
    control = int(p.ekf2_gps_ctrl)
    if not control & (_GPS_POSITION | _GPS_VELOCITY | _GPS_ALTITUDE) or not e.heading_aligned:
        e.gps_used = 0
        return
    if s.gps_fix < 3 or (not e.gps_good and (not e.gps_used or _other_horizontal_aiding(e))):
        e.gps_used = e.gps_used and not _other_horizontal_aiding(e)
        return
    if not e.origin.set:
        _set_origin(e.origin, e, s)
    horizontal = control & (_GPS_POSITION | _GPS_VELOCITY)
    if control & _GPS_ALTITUDE:
        down = e.origin.alt - s.gps_alt
        variance = max(1.5 * p.ekf2_gps_p_noise, s.gps_epv) ** 2
        e.innovation.pos[2] = down + e.height_offset[HEIGHT_GPS] - e.position[2]
        e.test_ratio.gps_hgt = _fuse_height(e, s, p, HEIGHT_GPS, down, variance, p.ekf2_gps_p_gate, work)
    if not horizontal:
        return
    north, east = _project(s.gps_lat, s.gps_lon, e.origin.lat, e.origin.lon)
    if not e.gps_used:
        e.gps_used = 1
        e.time_gps_fuse_us = s.time_us
        if not _other_horizontal_aiding(e) and not (e.located and e.position_valid):
            _reset_to_gps(e, s, p, north, east)
            return
    _fuse_gps_velocity(e, s, p, control, work)
    _fuse_gps_position(e, s, p, control, north, east, work)
    if not _is_recent(s.time_us, e.time_gps_fuse_us, _RESET_US):
        _reset_to_gps(e, s, p, north, east)


@kernel
def _set_origin(origin, e, s):
    """Set the origin so that the present GPS fix agrees with the present local position."""
    origin.lat, origin.lon, origin.alt = s.gps_lat, s.gps_lon, s.gps_alt
    if e.located:
        origin.lat, origin.lon = _reproject(-e.position[0], -e.position[1], s.gps_lat, s.gps_lon)
    if e.altitude_valid:
        origin.alt += e.position[2]
    origin.set = 1


@kernel
def _fuse_gps_velocity(e, s, p, control, work):
    e.test_ratio.vel = 0.0
    if not control & _GPS_VELOCITY:
        return
    variance = max(p.ekf2_gps_v_noise, s.gps_speed_accuracy) ** 2
    for i in range(3):
        e.innovation.vel[i] = s.gps_vel[i] - e.velocity[i]
        ratio = fuse_state(e, VEL + i, e.innovation.vel[i], variance, p.ekf2_gps_v_gate, work)
        e.test_ratio.vel = max(e.test_ratio.vel, ratio)
    if e.test_ratio.vel <= 1.0:
        e.time_last_vel_fuse_us = s.time_us


@kernel
def _fuse_gps_position(e, s, p, control, north, east, work):
    e.test_ratio.pos = 0.0
    if not control & _GPS_POSITION:
        e.time_gps_fuse_us = e.time_last_vel_fuse_us
        return
    variance = max(p.ekf2_gps_p_noise, s.gps_eph) ** 2
    e.innovation.pos[0], e.innovation.pos[1] = north - e.position[0], east - e.position[1]
    for i in range(2):
        ratio = fuse_state(e, POS + i, e.innovation.pos[i], variance, p.ekf2_gps_p_gate, work)
        e.test_ratio.pos = max(e.test_ratio.pos, ratio)
    if e.test_ratio.pos <= 1.0:
        e.time_last_pos_fuse_us = e.time_gps_fuse_us = s.time_us


@kernel
def _reset_to_gps(e, s, p, north, east):
    """Reset the horizontal state and the vertical velocity to a GPS fix."""
    variance = max(p.ekf2_gps_v_noise, s.gps_speed_accuracy) ** 2
    reset_position(e, north, east, max(p.ekf2_gps_p_noise, s.gps_eph) ** 2)
    if int(p.ekf2_gps_ctrl) & _GPS_VELOCITY:
        reset_velocity(e, s.gps_vel[0], s.gps_vel[1], variance)
        reset_vertical_velocity(e, s.gps_vel[2], variance)
    _mark_located(e, s)
    e.time_gps_fuse_us = s.time_us


@kernel
def _mark_located(e, s):
    """Mark the horizontal state as valid and fused now, after a reset to a source."""
    e.located = e.position_valid = e.velocity_valid = 1
    e.time_last_pos_fuse_us = e.time_last_vel_fuse_us = s.time_us


# height


@kernel
def _fuse_height(e, s, p, source, down, variance, gate, work):
    """Fuse a height, or start fusing its source.

    Args:
        e, s, p: the vehicle's records.
        source: ``HEIGHT_*``.
        down: measured down coordinate without the source's offset, m.
        variance: m^2.
        gate: innovation gate, standard deviations.
        work: (2, N_STATES) scratch.

    Returns:
        The innovation test ratio; 0 on a start.
    """
    is_reference = int(p.ekf2_hgt_ref) == source
    now = s.time_us
    if not e.height_used[source]:
        e.height_used[source] = 1
        e.time_height_fuse_us[source] = now
        if is_reference and source != HEIGHT_BARO:
            e.height_offset[source] = 0.0
            reset_height(e, down, variance)
        else:
            e.height_offset[source] = e.position[2] - down
            if not e.altitude_valid:
                reset_height(e, e.position[2], variance)
        e.altitude_valid = 1
        e.time_last_hgt_fuse_us = now
        return 0.0
    innovation = down + e.height_offset[source] - e.position[2]
    ratio = fuse_state(e, POS + 2, innovation, variance, gate, work)
    e.test_ratio.hgt = ratio
    e.innovation.hgt = innovation
    reference = int(p.ekf2_hgt_ref)
    known = 0 <= reference < len(e.height_used)  # a parameter may be out of range
    if (
        known
        and not is_reference
        and e.height_used[reference]
        and _is_recent(now, e.time_height_fuse_us[reference], _AIDING_US)
    ):
        e.height_offset[source] -= _OFFSET_GAIN * constrain(innovation, -1.0, 1.0)
    if ratio <= 1.0:
        e.time_height_fuse_us[source] = e.time_last_hgt_fuse_us = now
    elif now - e.time_height_fuse_us[source] > _HEIGHT_RESET_US:
        if is_reference or now - e.time_last_hgt_fuse_us > _HEIGHT_RESET_US:
            reset_height(e, down + e.height_offset[source], variance)
            e.time_last_hgt_fuse_us = now
        else:
            e.height_offset[source] = e.position[2] - down
        e.time_height_fuse_us[source] = now
    return ratio


@kernel
def _process_baro(e, s, p, work):
    e.time_baro_us = s.time_us
    if not int(p.ekf2_baro_ctrl):
        e.height_used[HEIGHT_BARO] = 0
        return
    is_reference = int(p.ekf2_hgt_ref) == HEIGHT_BARO
    # wait for the height reference, which would otherwise reset the height
    if not e.altitude_valid and not is_reference and s.time_us - e.time_aligned_us < _BARO_START_US:
        return
    down = e.origin.alt - s.baro_alt
    e.test_ratio.baro = _fuse_height(e, s, p, HEIGHT_BARO, down, p.ekf2_baro_noise**2, p.ekf2_baro_gate, work)


# range finder and optical flow


@kernel
def _tilt_cosine(e):
    return 1.0 - 2.0 * (e.q[1] * e.q[1] + e.q[2] * e.q[2])


@kernel
def _process_range(e, s, p, work):
    usable = s.range_quality != 0 and s.range_least <= s.range_distance <= s.range_largest
    cosine = _tilt_cosine(e)
    since = constrain((s.time_us - e.time_range_us) * 1e-6, 0.0, 1.0)
    e.time_range_us = s.time_us
    e.range_good = usable
    if not usable or cosine < _LEVEL_COSINE:
        return
    hagl = max(s.range_distance * cosine, p.ekf2_min_rng)
    variance = (p.ekf2_rng_noise**2 + (p.ekf2_rng_sfe * s.range_distance) ** 2) * cosine * cosine
    _fuse_terrain(e, s, p, hagl, variance, since)
    is_reference = int(p.ekf2_hgt_ref) == HEIGHT_RANGE
    control = int(p.ekf2_rng_ctrl)
    speed = math.sqrt(e.velocity[0] ** 2 + e.velocity[1] ** 2)
    low_and_slow = hagl < p.ekf2_rng_a_hmax and speed < p.ekf2_rng_a_vmax
    if control == 0 or not (is_reference or control == 2 or low_and_slow):
        e.height_used[HEIGHT_RANGE] = 0
        return
    e.innovation.range = e.height_offset[HEIGHT_RANGE] - hagl - e.position[2]
    e.test_ratio.range = _fuse_height(e, s, p, HEIGHT_RANGE, -hagl, variance, p.ekf2_rng_gate, work)


@kernel
def _fuse_terrain(e, s, p, hagl, variance, since):
    """Update the scalar Kalman filter of the terrain's down coordinate, as in PX4 v1.14."""
    measured = e.position[2] + hagl
    noise = variance + e.P[8, 8]
    if not _is_recent(s.time_us, e.time_terrain_fuse_us, _HEIGHT_RESET_US):
        e.terrain = measured
        e.terrain_variance = noise
        e.time_terrain_fuse_us = s.time_us
        return
    e.terrain_variance += p.ekf2_terr_noise**2 * _TERRAIN_RATE * since
    innovation = measured - e.terrain
    total = e.terrain_variance + noise
    e.test_ratio.terrain = innovation * innovation / (p.ekf2_rng_gate**2 * total)
    if e.test_ratio.terrain > 1.0:
        return
    gain = e.terrain_variance / total
    e.terrain += gain * innovation
    e.terrain_variance = max((1.0 - gain) * e.terrain_variance, _LEAST_TERRAIN_VARIANCE)
    e.time_terrain_fuse_us = s.time_us


@kernel
def _process_flow(e, s, p, work):
    e.time_flow_us = s.time_us
    e.flow_good = s.flow_quality >= p.ekf2_of_qmin
    known = _is_recent(s.time_us, e.time_terrain_fuse_us, _HEIGHT_RESET_US)
    if not int(p.ekf2_of_ctrl) or not e.flow_good or not known or _tilt_cosine(e) < _LEVEL_COSINE:
        return
    hagl = max(e.terrain - e.position[2], p.ekf2_min_rng)
    share = (s.flow_quality - p.ekf2_of_qmin) / max(255.0 - p.ekf2_of_qmin, 1.0)
    noise = p.ekf2_of_n_max + (p.ekf2_of_n_min - p.ekf2_of_n_max) * constrain(share, 0.0, 1.0)
    gx, gy = s.flow_gyro[0], s.flow_gyro[1]
    if math.isnan(gx) or math.isnan(gy):
        gx, gy = e.rates[0], e.rates[1]
    x, y = s.flow_rate[0] - gx, s.flow_rate[1] - gy
    speed_error = (x * x + y * y) * e.terrain_variance / (hagl * hagl)
    if not e.flow_used:
        _start_flow(e, s, x, y, hagl, noise)
        return
    e.test_ratio.flow = fuse_flow(e, x, y, hagl, noise**2 + speed_error, p.ekf2_of_gate, work)
    if e.test_ratio.flow <= 1.0:
        e.time_flow_fuse_us = e.time_last_vel_fuse_us = s.time_us
    elif not _is_recent(s.time_us, e.time_flow_fuse_us, _RESET_US):
        e.flow_used = 0


@kernel
def _start_flow(e, s, x, y, hagl, noise):
    """Start fusing optical flow; without another horizontal source, reset the velocity to it and keep the position."""
    e.flow_used = 1
    e.time_flow_fuse_us = s.time_us
    if e.gps_used or e.vision_position_used or e.vision_velocity_used:
        return
    reach = hagl / _tilt_cosine(e)
    north, east = _heading_to_local(e, y * reach, -x * reach)
    reset_velocity(e, north, east, (noise * reach) ** 2)
    if not e.located:
        reset_position(e, e.position[0], e.position[1], _LEAST_TERRAIN_VARIANCE)
    _mark_located(e, s)


@kernel
def _heading_to_local(e, forward, right):
    """Return (north, east) of a horizontal vector given as (forward, right) of the heading."""
    yaw = yaw_of(e.q)
    cos, sin = math.cos(yaw), math.sin(yaw)
    return cos * forward - sin * right, sin * forward + cos * right


# external vision


@kernel
def _process_vision(e, s, p, work):
    control = int(p.ekf2_ev_ctrl)
    first = not _is_recent(s.time_us, e.time_vision_us, _VISION_STOP_US)
    jumped = not first and s.vision_reset_counter != e.vision_reset_counter
    good = p.ekf2_ev_qmin <= 0.0 or s.vision_quality >= p.ekf2_ev_qmin
    e.vision_reset_counter = s.vision_reset_counter
    e.time_vision_us = s.time_us
    e.vision_good = good
    if not good:
        if jumped:  # the frame has changed, and a sample of bad quality cannot reset to it
            _stop_vision(e)
        return
    had_yaw = e.vision_yaw_used
    _vision_yaw(e, s, p, control, jumped, work)
    turned = jumped or had_yaw != e.vision_yaw_used
    q = _vision_rotation(e, s)
    _vision_velocity(e, s, p, control, jumped, q, work)
    _vision_position(e, s, p, control, turned, q, work)
    if control & _EV_HEIGHT and not math.isnan(s.vision_position[2]):
        if jumped:
            e.height_used[HEIGHT_VISION] = 0
        variance = _vision_variance(s.vision_position_variance[2], p.ekf2_evp_noise, p)
        down = s.vision_position[2]
        e.innovation.vision_pos[2] = down + e.height_offset[HEIGHT_VISION] - e.position[2]
        e.test_ratio.vision_hgt = _fuse_height(e, s, p, HEIGHT_VISION, down, variance, p.ekf2_evp_gate, work)


@kernel
def _stop_vision(e):
    e.vision_position_used = e.vision_velocity_used = e.vision_yaw_used = e.height_used[HEIGHT_VISION] = 0


@kernel
def _vision_variance(given, noise, p):
    """Return the larger of the message's and the parameter's variance; only the latter by EKF2_EV_NOISE_MD or NaN."""
    if int(p.ekf2_ev_noise_md) or math.isnan(given):
        return noise * noise
    return max(given, noise * noise)


@kernel
def _vision_rotation(e, s):
    """Return the quaternion (w, x, y, z) that rotates vision's frame into the local frame."""
    if s.vision_frame == VISION_NED or e.vision_yaw_used or math.isnan(s.vision_q[0]):
        return (1.0, 0.0, 0.0, 0.0)
    inverse = (s.vision_q[0], -s.vision_q[1], -s.vision_q[2], -s.vision_q[3])
    return multiply((e.q[0], e.q[1], e.q[2], e.q[3]), inverse)


@kernel
def _vision_yaw(e, s, p, control, jumped, work):
    north = s.vision_frame == VISION_NED
    if not control & _EV_YAW or math.isnan(s.vision_q[0]) or (not north and e.gps_used and e.heading_aligned):
        e.vision_yaw_used = 0
        return
    variance = _vision_variance(s.vision_yaw_variance, p.ekf2_eva_noise, p)
    innovation = wrap_pi(yaw_of(s.vision_q) - yaw_of(e.q))
    e.innovation.vision_yaw = innovation
    if e.vision_yaw_used and not jumped:
        _fuse_vision_yaw(e, s, p, innovation, variance, work)
    elif e.vision_yaw_used or not north or not e.heading_aligned:
        reset_yaw(e, innovation, variance)
        e.heading_aligned = north
        e.vision_yaw_used = 1
        e.mag_used = 0
        e.time_vision_fuse_us[2] = s.time_us
    else:
        _fuse_vision_yaw(e, s, p, innovation, variance, work)
        e.vision_yaw_used = e.test_ratio.vision_yaw <= 1.0


@kernel
def _fuse_vision_yaw(e, s, p, innovation, variance, work):
    e.test_ratio.vision_yaw = fuse_yaw(e, innovation, variance, p.ekf2_hdg_gate, work)
    if e.test_ratio.vision_yaw <= 1.0:
        e.time_vision_fuse_us[2] = e.time_heading_fuse_us = s.time_us
    elif e.vision_yaw_used and not _is_recent(s.time_us, e.time_vision_fuse_us[2], _AIDING_US):
        reset_yaw(e, innovation, variance)
        e.time_vision_fuse_us[2] = s.time_us


@kernel
def _vision_velocity(e, s, p, control, jumped, q, work):
    v = s.vision_velocity
    in_frame = s.vision_velocity_frame == VISION_BODY or e.heading_aligned or e.vision_yaw_used
    if not control & _EV_VELOCITY or math.isnan(v[0] + v[1] + v[2]) or not in_frame:
        e.vision_velocity_used = 0
        return
    rotation = q
    if s.vision_velocity_frame == VISION_BODY:
        rotation = (e.q[0], e.q[1], e.q[2], e.q[3])
    elif s.vision_velocity_frame == VISION_NED:
        rotation = (1.0, 0.0, 0.0, 0.0)
    x, y, z = rotate(rotation, v[0], v[1], v[2])
    measured = (x, y, z)
    variances = _rotated_variances(s.vision_velocity_variance, rotation, p.ekf2_evv_noise, p)
    if not e.vision_velocity_used or jumped:
        alone = not e.gps_used and not e.flow_used and not (e.vision_position_used and not jumped)
        e.vision_velocity_used = 1
        e.time_vision_fuse_us[1] = s.time_us
        if alone:
            reset_velocity(e, x, y, variances[0])
            reset_vertical_velocity(e, z, variances[2])
            _mark_located(e, s)
            return
    e.test_ratio.vision_vel = 0.0
    for i in range(3):
        e.innovation.vision_vel[i] = measured[i] - e.velocity[i]
        ratio = fuse_state(e, VEL + i, e.innovation.vision_vel[i], variances[i], p.ekf2_evv_gate, work)
        e.test_ratio.vision_vel = max(e.test_ratio.vision_vel, ratio)
    if e.test_ratio.vision_vel <= 1.0:
        e.time_vision_fuse_us[1] = e.time_last_vel_fuse_us = s.time_us
    elif not _is_recent(s.time_us, e.time_vision_fuse_us[1], _AIDING_US):
        reset_velocity(e, x, y, variances[0])
        reset_vertical_velocity(e, z, variances[2])
        e.time_vision_fuse_us[1] = e.time_last_vel_fuse_us = s.time_us


@kernel
def _rotated_variances(given, q, noise, p):
    """Return the variances of a vector with independent components after its rotation by ``q``."""
    vx = _vision_variance(given[0], noise, p)
    vy = _vision_variance(given[1], noise, p)
    vz = _vision_variance(given[2], noise, p)
    ax, ay, az = rotate(q, 1.0, 0.0, 0.0)
    bx, by, bz = rotate(q, 0.0, 1.0, 0.0)
    cx, cy, cz = rotate(q, 0.0, 0.0, 1.0)
    return (
        ax * ax * vx + bx * bx * vy + cx * cx * vz,
        ay * ay * vx + by * by * vy + cy * cy * vz,
        az * az * vx + bz * bz * vy + cz * cz * vz,
    )


@kernel
def _vision_position(e, s, p, control, jumped, q, work):
    position = s.vision_position
    in_frame = s.vision_frame == VISION_FRD or e.heading_aligned
    if not control & _EV_POSITION or math.isnan(position[0] + position[1]) or not in_frame:
        e.vision_position_used = 0
        return
    down = 0.0 if math.isnan(position[2]) else position[2]
    north, east, _ = rotate(q, position[0], position[1], down)
    variances = _rotated_variances(s.vision_position_variance, q, p.ekf2_evp_noise, p)
    variance = max(variances[0], variances[1])
    if e.gps_used:
        variance = max(variance, p.ekf2_gps_p_noise**2)
    if not e.vision_position_used or jumped:
        e.vision_position_used = 1
        _start_vision_position(e, s, north, east, variance)
        return
    e.test_ratio.vision_pos = 0.0
    measured = (north - e.vision_offset[0], east - e.vision_offset[1])
    for i in range(2):
        e.innovation.vision_pos[i] = measured[i] - e.position[i]
        ratio = fuse_state(e, POS + i, e.innovation.vision_pos[i], variance, p.ekf2_evp_gate, work)
        e.test_ratio.vision_pos = max(e.test_ratio.vision_pos, ratio)
        if e.gps_used:
            e.vision_offset[i] += _OFFSET_GAIN * constrain(e.innovation.vision_pos[i], -1.0, 1.0)
    if e.test_ratio.vision_pos <= 1.0:
        e.time_vision_fuse_us[0] = e.time_last_pos_fuse_us = s.time_us
    elif not _is_recent(s.time_us, e.time_vision_fuse_us[0], _AIDING_US):
        _start_vision_position(e, s, north, east, variance)


@kernel
def _start_vision_position(e, s, north, east, variance):
    """Reset the position to vision; while GPS sets the local frame, set vision's offset instead."""
    e.time_vision_fuse_us[0] = s.time_us
    if e.gps_used and e.position_valid:
        e.vision_offset[0], e.vision_offset[1] = north - e.position[0], east - e.position[1]
        return
    e.vision_offset[0] = e.vision_offset[1] = 0.0
    reset_position(e, north, east, variance)
    if not e.vision_velocity_used and not e.located:
        reset_velocity(e, 0.0, 0.0, 1.0)
    _mark_located(e, s)


# status


@kernel
def update_status(e, s, p, work):
    """Stop sources that have timed out and update the validity flags, at 25 Hz."""
    now = s.time_us
    if now % _STATUS_PERIOD_US:
        return
    _stop_timed_out(e, now)
    horizontal = max(e.time_last_pos_fuse_us, e.time_last_vel_fuse_us)
    aided = _is_recent(now, horizontal, _AIDING_US)
    e.dead_reckoning = not aided
    if aided:
        e.last_position[0], e.last_position[1] = e.position[0], e.position[1]
    if not (e.gps_used or _other_horizontal_aiding(e)):
        _hold_position(e, now, p, work)
    _update_faults(e, now)
    sound = e.fault_flags & (FAULT_NOT_FINITE | FAULT_NO_IMU) == 0
    e.attitude_valid = sound
    e.velocity_valid = sound and _is_recent(now, horizontal, p.ekf2_noaid_tout)
    e.position_valid = e.velocity_valid and e.located
    e.altitude_valid = sound and _is_recent(now, e.time_last_hgt_fuse_us, p.ekf2_noaid_tout)
    e.global_valid = e.position_valid and e.origin.set and e.heading_aligned
    e.terrain_valid = _is_recent(now, e.time_terrain_fuse_us, _HEIGHT_RESET_US)
    yaw_variance = _yaw_variance(e)
    e.heading_good = sound and e.heading_aligned and yaw_variance < _HEADING_LIMIT**2
    e.eph = math.sqrt(max(e.P[6, 6] + e.P[7, 7], 0.0))
    e.epv = math.sqrt(max(e.P[8, 8], 0.0))
    e.evh = math.sqrt(max(e.P[3, 3] + e.P[4, 4], 0.0))
    e.evv = math.sqrt(max(e.P[5, 5], 0.0))
    e.flags = _flags(e)


@kernel
def _yaw_variance(e):
    vx, vy, vz = rotate((e.q[0], -e.q[1], -e.q[2], -e.q[3]), 0.0, 0.0, 1.0)
    v = (vx, vy, vz)
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += v[i] * v[j] * e.P[i, j]
    return total


@kernel
def _stop_timed_out(e, now):
    gps_limit = _SENSOR_STOP_US if _other_horizontal_aiding(e) else _GPS_STOP_US
    if not _is_recent(now, e.time_last_gps_us, gps_limit):
        e.gps_used = 0
    if not _is_recent(now, e.time_last_gps_us, _SENSOR_STOP_US):
        e.gps_good = 0
        e.time_gps_fail_us = now  # restart the hold time
        e.height_used[HEIGHT_GPS] = 0
    if not _is_recent(now, e.time_vision_us, _VISION_STOP_US):
        e.vision_good = 0
        _stop_vision(e)
    if not _is_recent(now, e.time_flow_fuse_us, _RESET_US) or not _is_recent(now, e.time_flow_us, _SENSOR_STOP_US):
        e.flow_used = 0
    if not _is_recent(now, e.time_flow_us, _SENSOR_STOP_US):
        e.flow_good = 0
    if not _is_recent(now, e.time_range_us, _SENSOR_STOP_US):
        e.range_good = e.height_used[HEIGHT_RANGE] = 0
    e.baro_good = _is_recent(now, e.time_baro_us, _SENSOR_STOP_US)
    if not e.baro_good:
        e.height_used[HEIGHT_BARO] = 0
    if not _is_recent(now, e.time_mag_us, _SENSOR_STOP_US):
        e.mag_good = e.mag_used = 0
        e.test_ratio.mag = 0.0
    _clear_ratios(e.test_ratio, e)


@kernel
def _clear_ratios(ratio, e):
    """Set the test ratios of the sources that are not fused to 0."""
    if not e.gps_used:
        ratio.vel = ratio.pos = 0.0
    if not e.height_used[HEIGHT_GPS]:
        ratio.gps_hgt = 0.0
    if not e.height_used[HEIGHT_BARO]:
        ratio.baro = 0.0
    if not e.height_used[HEIGHT_RANGE]:
        ratio.range = 0.0
    if not e.flow_used:
        ratio.flow = 0.0
    if not e.vision_position_used:
        ratio.vision_pos = 0.0
    if not e.vision_velocity_used:
        ratio.vision_vel = 0.0
    if not e.height_used[HEIGHT_VISION]:
        ratio.vision_hgt = 0.0
    if not e.vision_yaw_used:
        ratio.vision_yaw = 0.0


@kernel
def _hold_position(e, now, p, work):
    """Fuse the last position loosely while no source aids, which bounds the tilt error (PX4's fake position)."""
    if not e.dead_reckoning or now % _HOLD_PERIOD_US:
        return
    variance = p.ekf2_noaid_noise**2
    for i in range(2):
        innovation = e.last_position[i] - e.position[i]
        if fuse_state(e, POS + i, innovation, variance, 3.0, work) > 1.0:
            e.last_position[i] = e.position[i]


@kernel
def _update_faults(e, now):
    faults = 0
    total = 0.0
    for i in range(N_STATES):
        total += e.P[i, i]
    for i in range(3):
        total += e.position[i] + e.velocity[i] + e.q[i]
    if not math.isfinite(total):
        faults |= FAULT_NOT_FINITE
    if now - e.time_imu_us > _IMU_STOP_US:
        faults |= FAULT_NO_IMU
    if e.time_mag_us > 0 and not e.mag_good and now - e.time_mag_us <= _SENSOR_STOP_US:
        faults |= FAULT_MAGNETIC
    e.fault_flags = faults


@kernel
def _flags(e):
    """Return ESTIMATOR_STATUS_FLAGS as PX4's get_ekf_soln_status does."""
    sound = e.fault_flags & (FAULT_NOT_FINITE | FAULT_NO_IMU) == 0
    if not sound:
        return _CONSTANT_POSITION
    absolute = e.gps_used or e.vision_position_used
    relative = absolute or e.flow_used
    flags = _ATTITUDE if e.heading_aligned or e.vision_yaw_used else 0
    flags |= _VELOCITY_XY if relative or e.vision_velocity_used else _CONSTANT_POSITION
    for i in range(4):
        if e.height_used[i]:
            flags |= _VELOCITY_Z | _HEIGHT
    flags |= _POSITION_RELATIVE | _PREDICTED_RELATIVE if relative else 0
    flags |= _POSITION_ABSOLUTE | _PREDICTED_ABSOLUTE if absolute else 0
    flags |= _HEIGHT_OVER_GROUND if e.terrain_valid else 0
    glitch = e.gps_used and (e.test_ratio.vel > 1.0 or e.test_ratio.pos > 1.0)
    return flags | (_GPS_GLITCH if glitch else 0)
