"""Hover thrust estimation in flight (PX4 mc_hover_thrust_estimator).

A Kalman filter with the constant state h: upward acceleration = g (thrust / h - 1), linearised about h. The noise of
the acceleration is estimated from the residuals.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.kernel import kernel
from xtdrone_common.geodesy.projection import GRAVITY
from xtdrone_common.rotation_kernels import constrain

_RESIDUAL_TAU = 1.0  # s
_NOISE_TAU = 2.0  # s, of the noise estimate
_FIRST_NOISE = 5.0  # m^2/s^4
_STUCK = 0.2  # low-passed test ratio above which the variance is raised
_SMALL_VARIANCE = 0.001  # below which the estimate is used
_VALID_TIME = 2.0  # s for which the variance must have been small


@kernel
def reset_hover_thrust(hover, p):
    """Reset the estimate to MPC_THR_HOVER with the standard deviation HTE_HT_ERR_INIT."""
    hover.estimate = p.mpc_thr_hover
    hover.variance = p.hte_ht_err_init * p.hte_ht_err_init
    hover.noise = _FIRST_NOISE
    hover.residual = 0.0
    hover.test_ratio = 0.0
    hover.valid_time = 0.0
    hover.valid = 0


@kernel
def estimate_hover_thrust(hover, e, p, thrust, dt):
    """Update the filter in the air after ``dt`` s; ``thrust`` (0..1) is the vertical part of the thrust setpoint."""
    h = hover.estimate
    acceleration = -e.acceleration[2]
    fast_z = max(abs(e.velocity[2]) - p.hte_vz_thr + 1.0, 1.0)
    fast_xy = max(math.hypot(e.velocity[0], e.velocity[1]) - p.hte_vxy_thr + 1.0, 1.0)
    noise = hover.noise * max(fast_z * fast_z, fast_xy * fast_xy)
    variance = hover.variance + p.hte_ht_noise * p.hte_ht_noise * dt * dt
    slope = -GRAVITY * thrust / (h * h)
    spread = max(slope * slope * variance + noise, noise)
    innovation = acceleration - (GRAVITY * thrust / h - GRAVITY)
    ratio = innovation * innovation / (p.hte_acc_gate * p.hte_acc_gate * spread)
    residual = innovation
    if ratio < 1.0:
        gain = variance * slope / spread
        low, high = p.mpc_thr_hover - p.hte_thr_range, p.mpc_thr_hover + p.hte_thr_range
        h = constrain(h + gain * innovation, max(low, 0.1), min(high, 0.9))
        variance = constrain((1.0 - gain * slope) * variance, 1e-10, 1.0)
        residual = acceleration - (GRAVITY * thrust / h - GRAVITY)
    elif abs(hover.test_ratio) > _STUCK:
        variance += 1e3 * p.hte_ht_noise * p.hte_ht_noise * dt
    hover.estimate, hover.variance = h, variance
    share = dt / (_RESIDUAL_TAU + dt)
    hover.residual += share * (residual - hover.residual)
    hover.test_ratio += share * (constrain(math.copysign(ratio, innovation), -1.0, 1.0) - hover.test_ratio)
    share = dt / (_NOISE_TAU + dt)
    scatter = (residual - hover.residual) ** 2 + slope * slope * variance
    hover.noise = constrain((1.0 - share) * hover.noise + share * scatter, 1.0, 400.0)
    small = variance < _SMALL_VARIANCE and (hover.valid or ratio < 1.0)
    hover.valid_time = hover.valid_time + dt if small else 0.0
    hover.valid = 1 if hover.valid_time >= _VALID_TIME else 0
