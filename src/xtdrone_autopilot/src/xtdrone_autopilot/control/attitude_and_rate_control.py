"""Attitude control, attitude setpoint to body rate setpoints, and rate control, those to normalised torques.

D. Brescianini, M. Hehn, R. D'Andrea, "Nonlinear quadrocopter attitude control", ETH Zurich 2013, with the yaw weight
of PX4's mc_att_control: tilt has priority over heading; PX4's lib/rate_control.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.kernel import kernel
from xtdrone_common.rotation_kernels import conjugate_multiply, constrain, multiply, rotate, rotate_inverse


@kernel
def attitude_control(c, e, p):
    """Update c.sp_rates (rad/s, body) from c.sp_q, e.q and the feed-forward c.sp_yaw_rate."""
    q = e.q
    # reduced attitude: the shortest rotation that aligns only the thrust axis (body z)
    ex, ey, ez = rotate(q, 0.0, 0.0, 1.0)
    dx, dy, dz = rotate(c.sp_q, 0.0, 0.0, 1.0)
    dot = ex * dx + ey * dy + ez * dz
    if dot < -0.99999:
        reduced = (c.sp_q[0], c.sp_q[1], c.sp_q[2], c.sp_q[3])
    else:
        w = 1.0 + dot
        cx, cy, cz = ey * dz - ez * dy, ez * dx - ex * dz, ex * dy - ey * dx
        norm = math.sqrt(w * w + cx * cx + cy * cy + cz * cz)
        reduced = multiply((w / norm, cx / norm, cy / norm, cz / norm), (q[0], q[1], q[2], q[3]))
    # the remaining rotation is about the thrust axis; weight it
    mix = conjugate_multiply(reduced, c.sp_q)
    weight = p.mc_yaw_weight
    half = weight * math.atan2(mix[3], mix[0]) if mix[0] >= 0.0 else weight * math.atan2(-mix[3], -mix[0])
    heading = (math.cos(half), 0.0, 0.0, math.sin(half))
    desired = multiply(reduced, heading)
    error = conjugate_multiply(q, desired)
    scale = 2.0 if error[0] >= 0.0 else -2.0
    # PX4 divides the yaw gain by the weight, so that MC_YAW_P is the gain of a pure heading error
    c.sp_rates[0] = scale * error[1] * p.mc_roll_p
    c.sp_rates[1] = scale * error[2] * p.mc_pitch_p
    c.sp_rates[2] = scale * error[3] * p.mc_yaw_p / weight
    if not math.isnan(c.sp_yaw_rate):
        fx, fy, fz = rotate_inverse(q, 0.0, 0.0, c.sp_yaw_rate)
        c.sp_rates[0] += fx
        c.sp_rates[1] += fy
        c.sp_rates[2] += fz
    roll_max = math.radians(p.mc_rollrate_max)
    pitch_max = math.radians(p.mc_pitchrate_max)
    yaw_max = math.radians(p.mc_yawrate_max)
    c.sp_rates[0] = constrain(c.sp_rates[0], -roll_max, roll_max)
    c.sp_rates[1] = constrain(c.sp_rates[1], -pitch_max, pitch_max)
    c.sp_rates[2] = constrain(c.sp_rates[2], -yaw_max, yaw_max)


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
