"""Takeoff: spool-up, ramp of the upward speed limit, flight (PX4 mc_pos_control/Takeoff)."""

from __future__ import annotations

from xtdrone_control.autopilot.state import (
    TAKEOFF_DISARMED,
    TAKEOFF_FLIGHT,
    TAKEOFF_RAMPUP,
    TAKEOFF_READY,
    TAKEOFF_SPOOLUP,
)
from xtdrone_control.geodesy.geo import GRAVITY
from xtdrone_control.kernel import kernel


@kernel
def update_takeoff(c, armed, p, wants_takeoff, skip):
    """Update c.takeoff_state.

    Args:
        c: ``CONTROL`` record.
        armed: whether the vehicle is armed.
        p: ``PARAMS`` record.
        wants_takeoff: whether the setpoint leads off the ground.
        skip: whether to skip the ramp, as the pilot sets the thrust directly.
    """
    if not armed:
        c.takeoff_state = TAKEOFF_DISARMED
        return
    if skip:
        c.takeoff_state = TAKEOFF_FLIGHT
        return
    if c.takeoff_state == TAKEOFF_DISARMED:
        c.takeoff_state = TAKEOFF_SPOOLUP if c.landed else TAKEOFF_FLIGHT
    if c.takeoff_state == TAKEOFF_SPOOLUP and c.armed_time >= p.com_spoolup_time:
        c.takeoff_state = TAKEOFF_READY
    if c.takeoff_state == TAKEOFF_READY and wants_takeoff:
        c.takeoff_state = TAKEOFF_RAMPUP
        c.ramp_progress = 0.0
    if c.takeoff_state == TAKEOFF_RAMPUP and c.ramp_progress >= 1.0:
        c.takeoff_state = TAKEOFF_FLIGHT
    if c.takeoff_state == TAKEOFF_FLIGHT and c.landed:
        c.takeoff_state = TAKEOFF_READY


@kernel
def update_ramp(c, p, speed_up, dt):
    """Update c.ramp_speed, the upward speed limit (m/s), which rises to ``speed_up`` within MPC_TKO_RAMP_T."""
    # start at the downward speed whose error cancels the hover thrust, so that thrust rises from zero
    start = -GRAVITY / max(p.mpc_z_vel_p_acc, 0.01)
    c.ramp_speed = speed_up
    if c.takeoff_state < TAKEOFF_RAMPUP:
        c.ramp_speed = start
    elif c.takeoff_state == TAKEOFF_RAMPUP:
        c.ramp_progress = c.ramp_progress + dt / p.mpc_tko_ramp_t if p.mpc_tko_ramp_t > dt else 1.0
        if c.ramp_progress < 1.0:
            c.ramp_speed = start + c.ramp_progress * (speed_up - start)
