"""Stick control without position or height estimates: tilt and thrust, or body rates and thrust.

After PX4 v1.14's mc_att_control (STABILIZED, MANUAL) and mc_rate_control (ACRO). Sticks are raw, -1..1.
"""

from __future__ import annotations

import math

from xtdrone_autopilot.kernel import kernel
from xtdrone_common.rotation_kernels import constrain, multiply, wrap_pi, yaw_of

_LEAST_THRUST_SLEW = 0.05  # 1/s, of c.throttle_min
_LARGEST_THRUST_SLEW = 0.5  # 1/s, of c.throttle_max after the spool-up
_YAW_THROTTLE = -0.9  # throttle stick below which the heading is kept, as the vehicle may be on the ground


@kernel
def update_throttle_limits(c, p, armed, dt):
    """Update c.throttle_min and c.throttle_max, the limits of the thrust by stick."""
    least = 0.0 if c.landing.landed else p.mpc_manthr_min
    step = _LEAST_THRUST_SLEW * dt
    c.throttle_min += constrain(least - c.throttle_min, -step, step)
    if armed and c.armed_time >= p.com_spoolup_time:
        c.throttle_max = min(c.throttle_max + _LARGEST_THRUST_SLEW * dt, 1.0)
    else:
        c.throttle_max = 0.0


@kernel
def stick_thrust(c, p, throttle):
    """Return the thrust (0..1) for the stick ``throttle`` (0..1), by MPC_THR_CURVE."""
    throttle = constrain(throttle, 0.0, 1.0)
    if p.mpc_thr_curve > 0.5:
        thrust = c.throttle_min + throttle * (p.mpc_thr_max - c.throttle_min)
    elif throttle < 0.5:
        thrust = c.throttle_min + 2.0 * throttle * (p.mpc_thr_hover - c.throttle_min)
    else:
        thrust = p.mpc_thr_hover + (2.0 * throttle - 1.0) * (p.mpc_thr_max - p.mpc_thr_hover)
    return min(thrust, c.throttle_max)


@kernel
def stick_attitude(c, s, e, p, dt):
    """Update c.sp_q, c.sp_yaw_rate and c.sp_thrust: sticks command tilt, yaw rate and thrust."""
    share = dt / (p.mc_man_tilt_tau + dt)
    c.stick_acceleration[0] += share * (s.stick_x - c.stick_acceleration[0])
    c.stick_acceleration[1] += share * (s.stick_y - c.stick_acceleration[1])
    most = math.radians(p.mpc_man_tilt_max)
    roll, pitch = c.stick_acceleration[1] * most, -c.stick_acceleration[0] * most
    tilt = math.hypot(roll, pitch)
    if tilt > most:
        roll, pitch = roll * most / tilt, pitch * most / tilt
        tilt = most
    if c.landing.landed:
        c.path.yaw = yaw_of(e.q)
    rate = 0.0
    if s.stick_z > _YAW_THROTTLE or p.mc_airmode > 1.5:
        rate = s.stick_yaw * math.radians(p.mpc_man_y_max)
    c.path.yaw = wrap_pi(c.path.yaw + rate * dt)
    scale = math.sin(0.5 * tilt) / tilt if tilt > 1e-6 else 0.5
    leaning = (math.cos(0.5 * tilt), roll * scale, pitch * scale, 0.0)
    heading = (math.cos(0.5 * c.path.yaw), 0.0, 0.0, math.sin(0.5 * c.path.yaw))
    q = multiply(heading, leaning)
    for i in range(4):
        c.sp_q[i] = q[i]
    c.sp_yaw = c.path.yaw
    c.sp_yaw_rate = rate
    c.sp_thrust = stick_thrust(c, p, 0.5 * (s.stick_z + 1.0))


@kernel
def _superexpo(value, expo, steepening):
    """Return the stick curve: ``expo`` blends linear to cubic, ``steepening`` raises the slope towards the ends."""
    x = constrain(value, -1.0, 1.0)
    return ((1.0 - expo) * x + expo * x * x * x) * (1.0 - steepening) / (1.0 - abs(x) * steepening)


@kernel
def stick_rates(c, s, p):
    """Update c.sp_rates and c.sp_thrust: sticks command body rates, the throttle stick the thrust directly."""
    expo, steep = p.mc_acro_expo, p.mc_acro_supexpo
    c.sp_rates[0] = _superexpo(s.stick_y, expo, steep) * math.radians(p.mc_acro_r_max)
    c.sp_rates[1] = _superexpo(-s.stick_x, expo, steep) * math.radians(p.mc_acro_p_max)
    c.sp_rates[2] = _superexpo(s.stick_yaw, p.mc_acro_expo_y, p.mc_acro_supexpoy) * math.radians(p.mc_acro_y_max)
    c.sp_thrust = constrain(0.5 * (s.stick_z + 1.0), 0.0, 1.0)
