"""Aiding by GPS, which needs a heading aligned with north (PX4: gps_control, gps_checks)."""

from __future__ import annotations

import math

from xtdrone_autopilot.estimator.aiding.source_timeouts import (
    RESET_US,
    is_recent,
    mark_located,
    other_horizontal_aiding,
)
from xtdrone_autopilot.estimator.aiding.sources.height_control import fuse_height
from xtdrone_autopilot.estimator.fusion import (
    POS,
    VEL,
    fuse_state,
    reset_position,
    reset_velocity,
    reset_vertical_velocity,
    to_origin,
)
from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import HEIGHT_GPS
from xtdrone_common.geodesy import projection

# EKF2_GPS_CHECK
_CHECK_SATELLITES, _CHECK_PDOP, _CHECK_EPH, _CHECK_EPV, _CHECK_SPEED = 1, 2, 4, 8, 16

_DELAY = 110.0  # ms, of the simulated receiver (EKF2_GPS_DELAY's default)

# EKF2_GPS_CTRL
_GPS_POSITION, _GPS_ALTITUDE, _GPS_VELOCITY = 1, 2, 4

_project = kernel(projection.project)
_reproject = kernel(projection.reproject)


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
def process_gps(e, s, p, work):
    """Process a GPS fix: velocity, position and altitude, as EKF2_GPS_CTRL enables them."""
    e.time_last_gps_us = s.time_us
    _check_gps(e, s, p)
    control = int(p.ekf2_gps_ctrl)
    if not control & (_GPS_POSITION | _GPS_VELOCITY | _GPS_ALTITUDE) or not e.heading_aligned:
        e.gps_used = 0
        return
    if s.gps_fix < 3 or (not e.gps_good and (not e.gps_used or other_horizontal_aiding(e))):
        e.gps_used = e.gps_used and not other_horizontal_aiding(e)
        return
    if not e.origin.set:
        _set_origin(e.origin, e, s)
    horizontal = control & (_GPS_POSITION | _GPS_VELOCITY)
    lag = (p.ekf2_gps_delay - _DELAY) * 1e-3
    shift, extra = to_origin(e, s, p.ekf2_gps_pos_x, p.ekf2_gps_pos_y, p.ekf2_gps_pos_z, lag)
    if control & _GPS_ALTITUDE:
        down = e.origin.alt - s.gps_alt + shift[2]
        variance = max(1.5 * p.ekf2_gps_p_noise, s.gps_epv) ** 2
        e.innovation.pos[2] = down + e.height_offset[HEIGHT_GPS] - e.position[2]
        e.test_ratio.gps_hgt = fuse_height(e, s, p, HEIGHT_GPS, down, variance, p.ekf2_gps_p_gate, work)
    if not horizontal:
        return
    north, east = _project(s.gps_lat, s.gps_lon, e.origin.lat, e.origin.lon)
    north, east = north + shift[0], east + shift[1]
    velocity = (s.gps_vel[0] + extra[0], s.gps_vel[1] + extra[1], s.gps_vel[2] + extra[2])
    if not e.gps_used:
        e.gps_used = 1
        e.time_gps_fuse_us = s.time_us
        if not other_horizontal_aiding(e) and not (e.located and e.position_valid):
            _reset_to_gps(e, s, p, north, east, velocity)
            return
    _fuse_gps_velocity(e, s, p, control, velocity, work)
    _fuse_gps_position(e, s, p, control, north, east, work)
    if not is_recent(s.time_us, e.time_gps_fuse_us, RESET_US):
        _reset_to_gps(e, s, p, north, east, velocity)


@kernel
def _set_origin(origin, e, s):
    """Set the origin so that the present GPS fix agrees with the current local position, unless it is preset."""
    origin.set = 1
    if origin.preset:
        return
    origin.lat, origin.lon, origin.alt = s.gps_lat, s.gps_lon, s.gps_alt
    if e.located:
        origin.lat, origin.lon = _reproject(-e.position[0], -e.position[1], s.gps_lat, s.gps_lon)
    if e.altitude_valid:
        origin.alt += e.position[2]


@kernel
def _fuse_gps_velocity(e, s, p, control, velocity, work):
    e.test_ratio.vel = 0.0
    if not control & _GPS_VELOCITY:
        return
    variance = max(p.ekf2_gps_v_noise, s.gps_speed_accuracy) ** 2
    for i in range(3):
        e.innovation.vel[i] = velocity[i] - e.velocity[i]
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
def _reset_to_gps(e, s, p, north, east, velocity):
    """Reset the horizontal state and the vertical velocity to a GPS fix."""
    variance = max(p.ekf2_gps_v_noise, s.gps_speed_accuracy) ** 2
    reset_position(e, north, east, max(p.ekf2_gps_p_noise, s.gps_eph) ** 2)
    if int(p.ekf2_gps_ctrl) & _GPS_VELOCITY:
        reset_velocity(e, velocity[0], velocity[1], variance)
        reset_vertical_velocity(e, velocity[2], variance)
    mark_located(e, s)
    e.time_gps_fuse_us = s.time_us
