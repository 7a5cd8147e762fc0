"""Discrete low-pass filters of PX4 v1.14 (lib/mathlib/math/filter, lib/controllib)."""

from __future__ import annotations

import math

from xtdrone_control.kernel import kernel


@kernel
def first_order_gain(cutoff_hz, dt):
    """Return the gain of a first-order low-pass (AlphaFilter, BlockLowPass); 1 (no filtering) for 0 Hz."""
    step = 2.0 * math.pi * cutoff_hz * dt
    return step / (1.0 + step) if cutoff_hz > 0.0 else 1.0


@kernel
def second_order_gains(cutoff_hz, dt):
    """Return b0, a1, a2 of a second-order Butterworth low-pass (LowPassFilter2p), where b1 = 2 b0 and b2 = b0.

    No filtering, (1, 0, 0), for 0 Hz or at least half of the sample rate.
    """
    if cutoff_hz <= 0.0 or 2.0 * cutoff_hz * dt >= 1.0:
        return 1.0, 0.0, 0.0
    w = math.tan(math.pi * cutoff_hz * dt)
    c = 1.0 + math.sqrt(2.0) * w + w * w
    return w * w / c, 2.0 * (w * w - 1.0) / c, (1.0 - math.sqrt(2.0) * w + w * w) / c
