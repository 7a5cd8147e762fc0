"""Land detection: ground contact, maybe landed, landed (PX4 MulticopterLandDetector)."""

from __future__ import annotations

import math

from xtdrone_control.kernel import kernel

_FREEFALL_ACCELERATION = 2.0  # m/s^2 of specific force, LNDMC_FFALL_THR
_FREEFALL_TIME = 0.3  # s, required duration
_LOW_THRUST, _LOW_THRUST_BY_ESTIMATE = 0.3, 0.6  # of the range from least to hover thrust
_LEAST_THRUST = 0.1  # of the same range
_DESCENT = 0.9  # of MPC_LAND_CRWL, least speed of a commanded descent
_STICK_MARGIN = 0.01  # thrust above MPC_MANTHR_MIN
_JUST_LANDED, _WIDER = 2.0, 2.5  # s after touch-down, and factor on the motion limits during it


@kernel
def _hold(seconds, condition, dt):
    return seconds + dt if condition else 0.0


@kernel
def _ground_contact(c, e, p, climb_controlled, factor):
    """Return whether thrust is low, the vehicle is still and, with a controlled climb rate, a descent is commanded."""
    share = _LOW_THRUST_BY_ESTIMATE if c.hover_valid else _LOW_THRUST
    hover = c.hover_estimate if c.hover_valid else p.mpc_thr_hover
    low = c.sp_thrust <= p.mpc_thr_min + share * (hover - p.mpc_thr_min)
    if climb_controlled and not (c.maybe_landed or c.landed):
        # a comparison with NaN (not controlled) is false: no descent
        down = c.sp_velocity[2] >= _DESCENT * max(p.mpc_land_crwl, 0.1) or c.sp_acceleration[2] >= 100.0
        low = low and down
    slow = abs(e.velocity[2]) < p.lndmc_z_vel_max * factor
    return low and slow and math.hypot(e.velocity[0], e.velocity[1]) < p.lndmc_xy_vel_max


@kernel
def _maybe_landed(c, e, p, climb_controlled, factor, dt):
    """Return whether thrust is minimal and the vehicle does not rotate, with ground contact."""
    hover = c.hover_estimate if c.hover_valid else p.mpc_thr_hover
    least = p.mpc_thr_min + _LEAST_THRUST * (hover - p.mpc_thr_min)
    if not climb_controlled:
        least = p.mpc_manthr_min + _STICK_MARGIN
    c.least_thrust_time = _hold(c.least_thrust_time, c.sp_thrust <= least, dt)
    if c.least_thrust_time == 0.0 or c.freefall:
        return False
    still = math.hypot(e.rates[0], e.rates[1]) < math.radians(p.lndmc_rot_max) * factor
    return still and c.ground_contact == 1


@kernel
def detect_landing(c, s, e, sensors, p, dt, climb_controlled):
    """Update the three stages; each must hold for a third of LNDMC_TRIG_TIME.

    Args:
        c, s, e, sensors, p: records.
        dt: time since the last call, s.
        climb_controlled: whether the flight task controls the climb rate.
    """
    third = p.lndmc_trig_time / 3.0
    force = math.sqrt(sensors.accel[0] ** 2 + sensors.accel[1] ** 2 + sensors.accel[2] ** 2)
    c.freefall_time = _hold(c.freefall_time, force < _FREEFALL_ACCELERATION, dt)
    c.freefall = 1 if c.freefall_time >= _FREEFALL_TIME else 0
    if not s.armed:
        # with stopped motors, a vehicle at rest is on the ground
        still = abs(e.velocity[2]) < p.lndmc_z_vel_max and not c.freefall
        still = still and math.hypot(e.velocity[0], e.velocity[1]) < p.lndmc_xy_vel_max
        c.landed_time = _hold(c.landed_time, still, dt)
        c.landed = 1 if still and (c.landed or c.landed_time >= third) else 0
        c.ground_contact = c.landed
        c.maybe_landed = c.landed
        c.ground_contact_time = c.maybe_landed_time = third if c.landed else 0.0
        c.since_maybe_landed = 0.0
        c.least_thrust_time = 0.0
        return
    c.since_maybe_landed = _hold(c.since_maybe_landed, c.maybe_landed == 1, dt)
    factor = _WIDER if c.maybe_landed and c.since_maybe_landed < _JUST_LANDED else 1.0
    contact = _ground_contact(c, e, p, climb_controlled, factor)
    c.ground_contact_time = _hold(c.ground_contact_time, contact, dt)
    c.ground_contact = 1 if c.ground_contact_time >= third else 0
    maybe = _maybe_landed(c, e, p, climb_controlled, factor, dt)
    c.maybe_landed_time = _hold(c.maybe_landed_time, maybe, dt)
    c.maybe_landed = 1 if c.maybe_landed_time >= third else 0
    c.landed_time = _hold(c.landed_time, c.maybe_landed == 1, dt)
    c.landed = 1 if c.landed_time >= third else 0
