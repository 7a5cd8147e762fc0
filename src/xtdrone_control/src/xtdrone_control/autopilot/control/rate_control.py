"""Rate control: body rate setpoints to normalised torques (PX4 lib/rate_control)."""

from __future__ import annotations

import math

from xtdrone_control.kernel import kernel
from xtdrone_control.rotation_kernels import constrain


@kernel
def _axis(c, e, i, gain_k, gain_p, gain_i, gain_d, gain_ff, limit, dt, integrate):
    """Return the torque of axis ``i`` and update its integral, which does not grow while the allocator saturates."""
    setpoint = c.sp_rates[i]
    error = setpoint - e.rates[i]
    torque = gain_k * (gain_p * error + gain_ff * setpoint - gain_d * e.angular_acceleration[i]) + c.rate_integral[i]
    if not integrate:
        return torque
    if c.saturation_pos[i]:
        error = min(error, 0.0)
    if c.saturation_neg[i]:
        error = max(error, 0.0)
    # slow the integral for large errors, for less bounce-back after flips (400 deg/s as in PX4)
    fade = error / math.radians(400.0)
    fade = max(0.0, 1.0 - fade * fade)
    c.rate_integral[i] = constrain(c.rate_integral[i] + fade * gain_k * gain_i * error * dt, -limit, limit)
    return torque


@kernel
def rate_control(c, e, p, dt, integrate):
    """Update c.sp_torque (normalised, body) from c.sp_rates; ``integrate`` is false on the ground."""
    c.sp_torque[0] = _axis(
        c, e, 0, p.mc_rollrate_k, p.mc_rollrate_p, p.mc_rollrate_i, p.mc_rollrate_d, p.mc_rollrate_ff,
        p.mc_rr_int_lim, dt, integrate,
    )  # fmt: skip
    c.sp_torque[1] = _axis(
        c, e, 1, p.mc_pitchrate_k, p.mc_pitchrate_p, p.mc_pitchrate_i, p.mc_pitchrate_d, p.mc_pitchrate_ff,
        p.mc_pr_int_lim, dt, integrate,
    )  # fmt: skip
    c.sp_torque[2] = _axis(
        c, e, 2, p.mc_yawrate_k, p.mc_yawrate_p, p.mc_yawrate_i, p.mc_yawrate_d, p.mc_yawrate_ff,
        p.mc_yr_int_lim, dt, integrate,
    )  # fmt: skip
