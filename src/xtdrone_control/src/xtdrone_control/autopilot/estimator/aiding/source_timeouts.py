"""Times without samples or fusion after which an aiding source stops, is reset, or leaves dead reckoning."""

from __future__ import annotations

from xtdrone_control.kernel import kernel

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
