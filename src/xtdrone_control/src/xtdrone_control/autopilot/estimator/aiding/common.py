"""Limits and helpers that several aiding sources share."""

from __future__ import annotations

from xtdrone_control.kernel import kernel

AIDING_US = 1_000_000  # without aiding for longer: dead reckoning (PX4: no_aid_timeout_max)
RESET_US = 7_000_000  # a source rejected for longer resets the state (PX4: reset_timeout_max)
HEIGHT_RESET_US = 5_000_000  # PX4: hgt_fusion_timeout_max
OFFSET_GAIN = 0.02  # share of each innovation added to a source's offset


@kernel
def is_recent(now_us, then_us, limit_us):
    """Return whether ``then_us`` is set (not 0) and at most ``limit_us`` before ``now_us``."""
    return then_us > 0 and now_us - then_us <= limit_us


@kernel
def other_horizontal_aiding(e):
    """Return whether a source other than GPS aids the horizontal state."""
    return e.vision_position_used or e.vision_velocity_used or e.flow_used


@kernel
def mark_located(e, s):
    """Mark the horizontal state as valid and fused now, after a reset to a source."""
    e.located = e.position_valid = e.velocity_valid = 1
    e.time_last_pos_fuse_us = e.time_last_vel_fuse_us = s.time_us
