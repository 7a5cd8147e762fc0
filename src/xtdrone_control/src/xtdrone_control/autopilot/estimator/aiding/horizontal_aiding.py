"""Horizontal aiding: whether a source other than GPS aids, and the flags set by a reset to a source."""

from __future__ import annotations

from xtdrone_control.kernel import kernel


@kernel
def other_horizontal_aiding(e):
    """Return whether a source other than GPS aids the horizontal state."""
    return e.vision_position_used or e.vision_velocity_used or e.flow_used


@kernel
def mark_located(e, s):
    """Mark the horizontal state as valid and fused now, after a reset to a source."""
    e.located = e.position_valid = e.velocity_valid = 1
    e.time_last_pos_fuse_us = e.time_last_vel_fuse_us = s.time_us
