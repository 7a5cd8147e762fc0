"""Take-off of one vehicle: spool-up, ramp of the upward speed limit, flight (PX4 mc_pos_control/Takeoff)."""

from __future__ import annotations

import math

from .kernel import kernel
from .state import (
    TAKEOFF_DISARMED,
    TAKEOFF_FLIGHT,
    TAKEOFF_RAMPUP,
    TAKEOFF_READY,
    TAKEOFF_SPOOLUP,
)

GRAVITY = 9.80665


@kernel
def wants_takeoff(c, e):
    """Return whether the trajectory set-point asks the vehicle to leave the ground."""
    return (
        c.sp_position[2] < e.position[2] - 0.2
        or c.sp_velocity[2] < -0.3
        or (math.isnan(c.sp_velocity[2]) and c.sp_acceleration[2] < -0.5)
    )


@kernel
def update_takeoff(c, s, e, p, dt, wants):
    """Advance c.takeoff_state and c.ramp_speed, the upward speed limit while the ramp lasts (m/s)."""
    c.takeoff_time += dt
    if not s.armed:
        c.takeoff_state = TAKEOFF_DISARMED
        return
    if c.takeoff_state == TAKEOFF_DISARMED:
        c.takeoff_state = TAKEOFF_SPOOLUP if c.landed else TAKEOFF_FLIGHT
        c.takeoff_time = 0.0
    elif c.takeoff_state == TAKEOFF_SPOOLUP:
        if c.takeoff_time >= p.com_spoolup_time:
            c.takeoff_state = TAKEOFF_READY
    elif c.takeoff_state == TAKEOFF_READY:
        if wants:
            c.takeoff_state = TAKEOFF_RAMPUP
            c.takeoff_time = 0.0
    elif c.takeoff_state == TAKEOFF_RAMPUP:
        if not wants:
            c.takeoff_state = TAKEOFF_READY
        elif c.takeoff_time >= p.mpc_tko_ramp_t:
            c.takeoff_state = TAKEOFF_FLIGHT
    elif c.landed:
        c.takeoff_state = TAKEOFF_READY
    # the ramp starts at the downward speed whose error gives no thrust, so that thrust rises from zero
    start = -GRAVITY / p.mpc_z_vel_p_acc
    share = min(c.takeoff_time / max(p.mpc_tko_ramp_t, dt), 1.0)
    c.ramp_speed = start + share * (p.mpc_tko_speed - start)
