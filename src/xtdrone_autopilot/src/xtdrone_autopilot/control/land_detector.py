"""Land detection: ground contact, maybe landed, landed (PX4 MulticopterLandDetector)."""

from __future__ import annotations

import math

from xtdrone_autopilot.kernel import kernel

_FREEFALL_ACCELERATION = 2.0  # m/s^2 of specific force, LNDMC_FFALL_THR
_FREEFALL_TIME = 0.3  # s, required duration
_LOW_THRUST, _LOW_THRUST_BY_ESTIMATE = 0.3, 0.6  # of the range from least to hover thrust
_LEAST_THRUST = 0.1  # of the same range
_DESCENT = 0.9  # of MPC_LAND_CRWL, minimum speed of a commanded descent
_STICK_MARGIN = 0.01  # thrust above MPC_MANTHR_MIN
_JUST_LANDED, _WIDER = 2.0, 2.5  # s after touch-down, and factor on the motion limits during it


@kernel
def _hold(seconds, condition, dt):
    return seconds + dt if condition else 0.0


@kernel
def _ground_contact(landing, c, e, p, climb_controlled, factor):
    """Return whether thrust is low, the vehicle is still and, with a controlled climb rate, a descent is commanded."""
    share = _LOW_THRUST_BY_ESTIMATE if c.hover.valid else _LOW_THRUST
    hover = c.hover.estimate if c.hover.valid else p.mpc_thr_hover
    low = c.sp_thrust <= p.mpc_thr_min + share * (hover - p.mpc_thr_min)
    if climb_controlled and not (landing.maybe_landed or landing.landed):
        # a comparison with NaN (not controlled) is false: no descent
        down = c.sp_velocity[2] >= _DESCENT * max(p.mpc_land_crwl, 0.1) or c.sp_acceleration[2] >= 100.0
        low = low and down
    slow = abs(e.velocity[2]) < p.lndmc_z_vel_max * factor
    return low and slow and math.hypot(e.velocity[0], e.velocity[1]) < p.lndmc_xy_vel_max


@kernel
def _maybe_landed(landing, c, e, p, climb_controlled, factor, dt):
    """Return whether thrust is minimal and the vehicle does not rotate, with ground contact."""
    hover = c.hover.estimate if c.hover.valid else p.mpc_thr_hover
    least = p.mpc_thr_min + _LEAST_THRUST * (hover - p.mpc_thr_min)
    if not climb_controlled:
        least = p.mpc_manthr_min + _STICK_MARGIN
    landing.least_thrust_time = _hold(landing.least_thrust_time, c.sp_thrust <= least, dt)
    if landing.least_thrust_time == 0.0 or landing.freefall:
        return False
    still = math.hypot(e.rates[0], e.rates[1]) < math.radians(p.lndmc_rot_max) * factor
    return still and landing.ground_contact == 1


@kernel
def detect_landing(landing, c, s, e, sensors, p, dt, climb_controlled):
    """Update the three stages; each must hold for a third of LNDMC_TRIG_TIME.

    Args:
        landing: ``LANDING`` record, the only one that is written.
        c, s, e, sensors, p: records.
        dt: time since the last call, s.
        climb_controlled: whether the flight task controls the climb rate.
    """
    third = p.lndmc_trig_time / 3.0
    force = math.sqrt(sensors.accel[0] ** 2 + sensors.accel[1] ** 2 + sensors.accel[2] ** 2)
    landing.freefall_time = _hold(landing.freefall_time, force < _FREEFALL_ACCELERATION, dt)
    landing.freefall = 1 if landing.freefall_time >= _FREEFALL_TIME else 0
    if not s.armed:
        # with stopped motors, a vehicle at rest is on the ground
        still = abs(e.velocity[2]) < p.lndmc_z_vel_max and not landing.freefall
        still = still and math.hypot(e.velocity[0], e.velocity[1]) < p.lndmc_xy_vel_max
        landing.landed_time = _hold(landing.landed_time, still, dt)
        landing.landed = 1 if still and (landing.landed or landing.landed_time >= third) else 0
        landing.ground_contact = landing.landed
        landing.maybe_landed = landing.landed
        landing.ground_contact_time = landing.maybe_landed_time = third if landing.landed else 0.0
        landing.since_maybe_landed = 0.0
        landing.least_thrust_time = 0.0
        return
    landing.since_maybe_landed = _hold(landing.since_maybe_landed, landing.maybe_landed == 1, dt)
    factor = _WIDER if landing.maybe_landed and landing.since_maybe_landed < _JUST_LANDED else 1.0
    contact = _ground_contact(landing, c, e, p, climb_controlled, factor)
    landing.ground_contact_time = _hold(landing.ground_contact_time, contact, dt)
    landing.ground_contact = 1 if landing.ground_contact_time >= third else 0
    maybe = _maybe_landed(landing, c, e, p, climb_controlled, factor, dt)
    landing.maybe_landed_time = _hold(landing.maybe_landed_time, maybe, dt)
    landing.maybe_landed = 1 if landing.maybe_landed_time >= third else 0
    landing.landed_time = _hold(landing.landed_time, landing.maybe_landed == 1, dt)
    landing.landed = 1 if landing.landed_time >= third else 0
