"""Aiding by external vision (PX4: ev_control, ev_yaw_control, ev_vel_control, ev_pos_control, ev_height_control).

Vision in a frame that is not aligned with north (VISION_FRD) also sets the heading; the magnetometer and GPS are then
not used.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.estimator.aiding.source_timeouts import (
    AIDING_US,
    VISION_STOP_US,
    is_recent,
    mark_located,
    stop_vision,
)
from xtdrone_autopilot.estimator.aiding.sources.height_control import OFFSET_GAIN, fuse_height
from xtdrone_autopilot.estimator.fusion import (
    POS,
    VEL,
    fuse_state,
    fuse_yaw,
    reset_position,
    reset_velocity,
    reset_vertical_velocity,
    reset_yaw,
    to_origin,
)
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import HEIGHT_VISION, VISION_BODY, VISION_FRD, VISION_NED
from xtdrone_common.rotation_kernels import constrain, multiply, rotate, wrap_pi, yaw_of

# EKF2_EV_CTRL
_EV_POSITION, _EV_HEIGHT, _EV_VELOCITY, _EV_YAW = 1, 2, 4, 8


@kernel
def process_vision(e, s, p, work):
    """Process a sample of external vision: yaw, velocity, position and height, as EKF2_EV_CTRL enables them."""
    control = int(p.ekf2_ev_ctrl)
    first = not is_recent(s.time_us, e.time_vision_us, VISION_STOP_US)
    jumped = not first and s.vision_reset_counter != e.vision_reset_counter
    good = p.ekf2_ev_qmin <= 0.0 or s.vision_quality >= p.ekf2_ev_qmin
    e.vision_reset_counter = s.vision_reset_counter
    e.time_vision_us = s.time_us
    e.vision_good = good
    if not good:
        if jumped:  # the frame has changed, and a sample of bad quality cannot reset to it
            stop_vision(e)
        return
    had_yaw = e.vision_yaw_used
    _vision_yaw(e, s, p, control, jumped, work)
    turned = jumped or had_yaw != e.vision_yaw_used
    q = _vision_rotation(e, s)
    shift, extra = to_origin(e, s, p.ekf2_ev_pos_x, p.ekf2_ev_pos_y, p.ekf2_ev_pos_z, p.ekf2_ev_delay * 1e-3)
    _vision_velocity(e, s, p, control, jumped, q, extra, work)
    _vision_position(e, s, p, control, turned, q, shift, work)
    if control & _EV_HEIGHT and not math.isnan(s.vision_position[2]):
        if jumped:
            e.height_used[HEIGHT_VISION] = 0
        variance = _vision_variance(s.vision_position_variance[2], p.ekf2_evp_noise, p)
        down = s.vision_position[2] + shift[2]
        e.innovation.vision_pos[2] = down + e.height_offset[HEIGHT_VISION] - e.position[2]
        e.test_ratio.vision_hgt = fuse_height(e, s, p, HEIGHT_VISION, down, variance, p.ekf2_evp_gate, work)


@kernel
def _vision_variance(given, noise, p):
    """Return the larger of the message's and the parameter's variance; the latter by EKF2_EV_NOISE_MD or for NaN."""
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
    turn = (s.gyro[2] - e.gyro_bias[2]) * p.ekf2_ev_delay * 1e-3
    innovation = wrap_pi(yaw_of(s.vision_q) + turn - yaw_of(e.q))
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
    elif e.vision_yaw_used and not is_recent(s.time_us, e.time_vision_fuse_us[2], AIDING_US):
        reset_yaw(e, innovation, variance)
        e.time_vision_fuse_us[2] = s.time_us


@kernel
def _vision_velocity(e, s, p, control, jumped, q, extra, work):
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
    x, y, z = x + extra[0], y + extra[1], z + extra[2]
    measured = (x, y, z)
    variances = _rotated_variances(s.vision_velocity_variance, rotation, p.ekf2_evv_noise, p)
    if not e.vision_velocity_used or jumped:
        alone = not e.gps_used and not e.flow_used and not (e.vision_position_used and not jumped)
        e.vision_velocity_used = 1
        e.time_vision_fuse_us[1] = s.time_us
        if alone:
            reset_velocity(e, x, y, variances[0])
            reset_vertical_velocity(e, z, variances[2])
            mark_located(e, s)
            return
    e.test_ratio.vision_vel = 0.0
    for i in range(3):
        e.innovation.vision_vel[i] = measured[i] - e.velocity[i]
        ratio = fuse_state(e, VEL + i, e.innovation.vision_vel[i], variances[i], p.ekf2_evv_gate, work)
        e.test_ratio.vision_vel = max(e.test_ratio.vision_vel, ratio)
    if e.test_ratio.vision_vel <= 1.0:
        e.time_vision_fuse_us[1] = e.time_last_vel_fuse_us = s.time_us
    elif not is_recent(s.time_us, e.time_vision_fuse_us[1], AIDING_US):
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
def _vision_position(e, s, p, control, jumped, q, shift, work):
    position = s.vision_position
    in_frame = s.vision_frame == VISION_FRD or e.heading_aligned
    if not control & _EV_POSITION or math.isnan(position[0] + position[1]) or not in_frame:
        e.vision_position_used = 0
        return
    down = 0.0 if math.isnan(position[2]) else position[2]
    north, east, _ = rotate(q, position[0], position[1], down)
    north, east = north + shift[0], east + shift[1]
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
            e.vision_offset[i] += OFFSET_GAIN * constrain(e.innovation.vision_pos[i], -1.0, 1.0)
    if e.test_ratio.vision_pos <= 1.0:
        e.time_vision_fuse_us[0] = e.time_last_pos_fuse_us = s.time_us
    elif not is_recent(s.time_us, e.time_vision_fuse_us[0], AIDING_US):
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
    mark_located(e, s)
