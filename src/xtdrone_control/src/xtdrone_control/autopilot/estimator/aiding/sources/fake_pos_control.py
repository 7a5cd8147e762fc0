"""Position hold of the estimate without aiding: the last position is fused loosely (PX4: fake_pos_control)."""

from __future__ import annotations

from xtdrone_control.autopilot.estimator.fusion import POS, fuse_state
from xtdrone_control.kernel import kernel

_HOLD_PERIOD_US = 200_000  # PX4: fake position at 5 Hz


@kernel
def hold_position(e, now, p, work):
    """Fuse the last position loosely while no source aids, which bounds the tilt error (PX4's fake position)."""
    if not e.dead_reckoning or now % _HOLD_PERIOD_US:
        return
    variance = p.ekf2_noaid_noise**2
    for i in range(2):
        innovation = e.last_position[i] - e.position[i]
        if fuse_state(e, POS + i, innovation, variance, 3.0, work) > 1.0:
            e.last_position[i] = e.position[i]
