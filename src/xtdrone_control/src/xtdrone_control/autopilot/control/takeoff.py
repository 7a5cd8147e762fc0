"""Takeoff of one vehicle: spool-up, ramp of the upward speed limit, flight (PX4 mc_pos_control/Takeoff)."""

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
def update_takeoff(c, armed, p, wants, skip):
    """Advance c.takeoff_state.

    Args:
        c: ``CONTROL`` record.
        armed: whether motors run.
        p: ``PARAMS`` record.
        wants: the setpoint asks the vehicle to leave the ground.
        skip: nothing controls the climb rate, so nothing is ramped up: the pilot's thrust lifts the vehicle.
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
    if c.takeoff_state == TAKEOFF_READY and wants:
        c.takeoff_state = TAKEOFF_RAMPUP
        c.ramp_progress = 0.0
    if c.takeoff_state == TAKEOFF_RAMPUP and c.ramp_progress >= 1.0:
        c.takeoff_state = TAKEOFF_FLIGHT
    if c.takeoff_state == TAKEOFF_FLIGHT and c.landed:
        c.takeoff_state = TAKEOFF_READY


@kernel
def update_ramp(c, p, speed_up, dt):
    """Advance c.ramp_speed, the upward speed limit (m/s), which ends at ``speed_up`` after MPC_TKO_RAMP_T."""
    # it begins with the downward speed whose error takes all thrust away, so that thrust rises from zero
    start = -GRAVITY / max(p.mpc_z_vel_p_acc, 0.01)
    c.ramp_speed = speed_up
    if c.takeoff_state < TAKEOFF_RAMPUP:
        c.ramp_speed = start
    elif c.takeoff_state == TAKEOFF_RAMPUP:
        c.ramp_progress = c.ramp_progress + dt / p.mpc_tko_ramp_t if p.mpc_tko_ramp_t > dt else 1.0
        if c.ramp_progress < 1.0:
            c.ramp_speed = start + c.ramp_progress * (speed_up - start)
