"""Takeoff: spool-up, ramp of the upward speed limit, flight (PX4 mc_pos_control/Takeoff)."""

from __future__ import annotations

from xtdrone_control.autopilot.state import (
    TAKEOFF_DISARMED,
    TAKEOFF_FLIGHT,
    TAKEOFF_RAMPUP,
    TAKEOFF_READY,
    TAKEOFF_SPOOLUP,
)
from xtdrone_control.geodesy.projection import GRAVITY
from xtdrone_control.kernel import kernel


@kernel
def update_takeoff(takeoff, c, armed, p, wants_takeoff, skip):
    """Update takeoff.state.

    Args:
        takeoff: ``TAKEOFF`` record.
        c: ``CONTROL`` record, read only.
        armed: whether the vehicle is armed.
        p: ``PARAMS`` record.
        wants_takeoff: whether the setpoint leads off the ground.
        skip: whether to skip the ramp, as the pilot sets the thrust directly.
    """
    if not armed:
        takeoff.state = TAKEOFF_DISARMED
        return
    if skip:
        takeoff.state = TAKEOFF_FLIGHT
        return
    if takeoff.state == TAKEOFF_DISARMED:
        takeoff.state = TAKEOFF_SPOOLUP if c.landing.landed else TAKEOFF_FLIGHT
    if takeoff.state == TAKEOFF_SPOOLUP and c.armed_time >= p.com_spoolup_time:
        takeoff.state = TAKEOFF_READY
    if takeoff.state == TAKEOFF_READY and wants_takeoff:
        takeoff.state = TAKEOFF_RAMPUP
        takeoff.ramp_progress = 0.0
    if takeoff.state == TAKEOFF_RAMPUP and takeoff.ramp_progress >= 1.0:
        takeoff.state = TAKEOFF_FLIGHT
    if takeoff.state == TAKEOFF_FLIGHT and c.landing.landed:
        takeoff.state = TAKEOFF_READY


@kernel
def update_ramp(takeoff, p, speed_up, dt):
    """Update takeoff.ramp_speed, the upward speed limit (m/s), which rises to ``speed_up`` within MPC_TKO_RAMP_T."""
    # start at the downward speed whose error cancels the hover thrust, so that thrust rises from zero
    start = -GRAVITY / max(p.mpc_z_vel_p_acc, 0.01)
    takeoff.ramp_speed = speed_up
    if takeoff.state < TAKEOFF_RAMPUP:
        takeoff.ramp_speed = start
    elif takeoff.state == TAKEOFF_RAMPUP:
        takeoff.ramp_progress = takeoff.ramp_progress + dt / p.mpc_tko_ramp_t if p.mpc_tko_ramp_t > dt else 1.0
        if takeoff.ramp_progress < 1.0:
            takeoff.ramp_speed = start + takeoff.ramp_progress * (speed_up - start)
