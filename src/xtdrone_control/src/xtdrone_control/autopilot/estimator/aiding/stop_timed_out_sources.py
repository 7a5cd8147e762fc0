"""Stop the sources that have timed out: GPS, vision, optical flow, range finder, barometer, magnetometer."""

from __future__ import annotations

from xtdrone_control.autopilot.estimator.aiding.horizontal_aiding import other_horizontal_aiding
from xtdrone_control.autopilot.estimator.aiding.source_timeouts import (
    GPS_STOP_US,
    RESET_US,
    SENSOR_STOP_US,
    VISION_STOP_US,
    is_recent,
)
from xtdrone_control.autopilot.estimator.aiding.sources.external_vision_control import stop_vision
from xtdrone_control.autopilot.state import HEIGHT_BARO, HEIGHT_GPS, HEIGHT_RANGE, HEIGHT_VISION
from xtdrone_control.kernel import kernel


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
