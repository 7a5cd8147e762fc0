"""Validity flags, accuracies and faults of the estimate, and ESTIMATOR_STATUS_FLAGS, after PX4's ekf_helper."""

from __future__ import annotations

import math

from xtdrone_autopilot.estimator.aiding.source_timeouts import (
    AIDING_US,
    HEIGHT_RESET_US,
    IMU_STOP_US,
    SENSOR_STOP_US,
    is_recent,
    other_horizontal_aiding,
    stop_timed_out,
)
from xtdrone_autopilot.estimator.fusion import POS, fuse_state
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import N_STATES
from xtdrone_common.rotation_kernels import rotate

FAULT_NOT_FINITE, FAULT_NO_IMU, FAULT_MAGNETIC = 1, 2, 4  # ESTIMATOR.fault_flags

_STATUS_PERIOD_US = 40_000
_HEADING_LIMIT = 0.3  # rad, largest 1 sigma of a good heading

# ESTIMATOR_STATUS_FLAGS
_ATTITUDE, _VELOCITY_XY, _VELOCITY_Z, _POSITION_RELATIVE, _POSITION_ABSOLUTE, _HEIGHT = 1, 2, 4, 8, 16, 32
_HEIGHT_OVER_GROUND, _CONSTANT_POSITION, _PREDICTED_RELATIVE, _PREDICTED_ABSOLUTE = 64, 128, 256, 512
_GPS_GLITCH = 1024


@kernel
def update_status(e, s, p, work):
    """Stop sources that have timed out and update the validity flags, at 25 Hz."""
    now = s.time_us
    if now % _STATUS_PERIOD_US:
        return
    stop_timed_out(e, now)
    horizontal = max(e.time_last_pos_fuse_us, e.time_last_vel_fuse_us)
    aided = is_recent(now, horizontal, AIDING_US)
    e.dead_reckoning = not aided
    if aided:
        e.last_position[0], e.last_position[1] = e.position[0], e.position[1]
    if not (e.gps_used or other_horizontal_aiding(e)):
        _hold_position(e, now, p, work)
    _update_faults(e, now)
    sound = e.fault_flags & (FAULT_NOT_FINITE | FAULT_NO_IMU) == 0
    e.attitude_valid = sound
    e.velocity_valid = sound and is_recent(now, horizontal, p.ekf2_noaid_tout)
    e.position_valid = e.velocity_valid and e.located
    e.altitude_valid = sound and is_recent(now, e.time_last_hgt_fuse_us, p.ekf2_noaid_tout)
    e.global_valid = e.position_valid and e.origin.set and e.heading_aligned
    e.terrain_valid = is_recent(now, e.time_terrain_fuse_us, HEIGHT_RESET_US)
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
def _update_faults(e, now):
    faults = 0
    total = 0.0
    for i in range(N_STATES):
        total += e.P[i, i]
    for i in range(3):
        total += e.position[i] + e.velocity[i] + e.q[i]
    if not math.isfinite(total):
        faults |= FAULT_NOT_FINITE
    if now - e.time_imu_us > IMU_STOP_US:
        faults |= FAULT_NO_IMU
    if e.time_mag_us > 0 and not e.mag_good and now - e.time_mag_us <= SENSOR_STOP_US:
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


_HOLD_PERIOD_US = 200_000  # PX4: fake position at 5 Hz


@kernel
def _hold_position(e, now, p, work):
    """Fuse the last position loosely while no source aids, which bounds the tilt error (PX4: fake_pos_control)."""
    if not e.dead_reckoning or now % _HOLD_PERIOD_US:
        return
    variance = p.ekf2_noaid_noise**2
    for i in range(2):
        innovation = e.last_position[i] - e.position[i]
        if fuse_state(e, POS + i, innovation, variance, 3.0, work) > 1.0:
            e.last_position[i] = e.position[i]
