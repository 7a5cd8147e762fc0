"""Horizontal aiding, and timeouts of the sources: times without samples or fusion, and their consequences.

After a timeout a source stops, the state is reset to it, or the estimate counts as dead reckoning.
"""

from __future__ import annotations

from xtdrone_autopilot.kernel import kernel
from xtdrone_autopilot.state import HEIGHT_BARO, HEIGHT_GPS, HEIGHT_RANGE, HEIGHT_VISION

AIDING_US = 1_000_000  # without aiding for longer: dead reckoning (PX4: no_aid_timeout_max)
RESET_US = 7_000_000  # a source rejected for longer resets the state (PX4: reset_timeout_max)
HEIGHT_RESET_US = 5_000_000  # PX4: hgt_fusion_timeout_max
GPS_STOP_US = 10_000_000  # GPS timeout; SENSOR_STOP_US with another horizontal source
SENSOR_STOP_US = 1_000_000
VISION_STOP_US = 400_000  # PX4: twice EV_MAX_INTERVAL
IMU_STOP_US = 200_000


@kernel
def is_recent(now_us, then_us, limit_us):
    """Return whether ``then_us`` is set (not 0) and at most ``limit_us`` before ``now_us``."""
    return then_us > 0 and now_us - then_us <= limit_us


@kernel
def stop_vision(e):
    """Stop the fusion of all vision measurements."""
    e.vision_position_used = e.vision_velocity_used = e.vision_yaw_used = e.height_used[HEIGHT_VISION] = 0


@kernel
def stop_timed_out(e, now):
    """Stop each source without a sample, or the flow without fusion, for its timeout."""
    gps_limit = SENSOR_STOP_US if other_horizontal_aiding(e) else GPS_STOP_US
    if not is_recent(now, e.time_last_gps_us, gps_limit):
        e.gps_used = 0
    if not is_recent(now, e.time_last_gps_us, SENSOR_STOP_US):
        e.gps_good = 0
        e.time_gps_fail_us = now  # restart the hold time
        e.height_used[HEIGHT_GPS] = 0
    if not is_recent(now, e.time_vision_us, VISION_STOP_US):
        e.vision_good = 0
        stop_vision(e)
    if not is_recent(now, e.time_flow_fuse_us, RESET_US) or not is_recent(now, e.time_flow_us, SENSOR_STOP_US):
        e.flow_used = 0
    if not is_recent(now, e.time_flow_us, SENSOR_STOP_US):
        e.flow_good = 0
    if not is_recent(now, e.time_range_us, SENSOR_STOP_US):
        e.range_good = e.height_used[HEIGHT_RANGE] = 0
    e.baro_good = is_recent(now, e.time_baro_us, SENSOR_STOP_US)
    if not e.baro_good:
        e.height_used[HEIGHT_BARO] = 0
    if not is_recent(now, e.time_mag_us, SENSOR_STOP_US):
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
def other_horizontal_aiding(e):
    """Return whether a source other than GPS aids the horizontal state."""
    return e.vision_position_used or e.vision_velocity_used or e.flow_used


@kernel
def mark_located(e, s):
    """Mark the horizontal state as valid and fused now, after a reset to a source."""
    e.located = e.position_valid = e.velocity_valid = 1
    e.time_last_pos_fuse_us = e.time_last_vel_fuse_us = s.time_us
