"""Dispatch of each fresh sample to the module of its source, and the rates at which samples are used.

After PX4 v1.14's EKF2 (control). Each source's module starts and stops its fusion, checks its samples, and resets the
state to it after a long rejection; ``source_timeouts`` stops sources that are silent.
"""

from __future__ import annotations

from xtdrone_control.autopilot.estimator.aiding.sources.external_vision_control import process_vision
from xtdrone_control.autopilot.estimator.aiding.sources.flow_control import process_flow
from xtdrone_control.autopilot.estimator.aiding.sources.gps_control import process_gps
from xtdrone_control.autopilot.estimator.aiding.sources.height_control import process_baro
from xtdrone_control.autopilot.estimator.aiding.sources.mag_control import process_mag
from xtdrone_control.autopilot.estimator.aiding.sources.range_control import process_range
from xtdrone_control.kernel import kernel

_MAG_PERIOD_US = 60_000  # PX4: SENS_MAG_RATE 15 Hz, rounded to the magnetometer's 50 Hz
_BARO_PERIOD_US = 50_000  # PX4: SENS_BARO_RATE 20 Hz


@kernel
def update_imu_time(e, s):
    """Store the time of this step's IMU sample; return whether there is one."""
    if s.imu_missing:
        return False
    e.time_imu_us = s.time_us
    return True


@kernel
def fuse_sources(e, s, p, work):
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
