"""Land detection of one vehicle: ground contact, maybe landed, landed (PX4 MulticopterLandDetector)."""

from __future__ import annotations

import math

from .kernel import kernel
from .state import TAKEOFF_RAMPUP

_FREEFALL_ACCELERATION = 2.0  # m/s^2 of specific force, LNDMC_FFALL_THR
_LOW_THRUST_SHARE = 0.3  # between least and hover thrust, LNDMC_LOW_T_THR
_DESCEND_SPEED = 0.25  # m/s of wanted descent from which touching ground is meant


@kernel
def _hold(seconds, condition, dt):
    return seconds + dt if condition else 0.0


@kernel
def detect_landing(c, s, e, sensors, p, dt, wants):
    """Advance the three stages; each must hold for a third of LNDMC_TRIG_TIME before the next.

    ``wants`` says that the set-point asks to leave the ground, which ends any contact.
    """
    third = p.lndmc_trig_time / 3.0
    force = math.sqrt(sensors.accel[0] ** 2 + sensors.accel[1] ** 2 + sensors.accel[2] ** 2)
    c.freefall = 1 if force < _FREEFALL_ACCELERATION else 0
    slow_z = abs(e.velocity[2]) < p.lndmc_z_vel_max
    slow_xy = math.hypot(e.velocity[0], e.velocity[1]) < p.lndmc_xy_vel_max
    rate_limit = math.radians(p.lndmc_rot_max)
    still = math.hypot(e.rates[0], e.rates[1]) < rate_limit
    if not s.armed:
        # motors are off: at rest means on the ground
        c.landed_time = _hold(c.landed_time, slow_z and slow_xy and not c.freefall, dt)
        c.landed = 1 if c.landed_time >= third else c.landed
        if not (slow_z and slow_xy) or c.freefall:
            c.landed = 0
        c.ground_contact = c.landed
        c.maybe_landed = c.landed
        return
    if c.landed and c.takeoff_state < TAKEOFF_RAMPUP:
        return
    thrust = -c.sp_thrust_vector[2]
    low_thrust = thrust <= p.mpc_thr_min + _LOW_THRUST_SHARE * (c.hover_thrust - p.mpc_thr_min)
    descending = c.sp_velocity[2] >= _DESCEND_SPEED or c.ground_contact == 1
    if wants or c.takeoff_state == TAKEOFF_RAMPUP:
        descending = False
    contact = descending and low_thrust and slow_z and slow_xy
    c.ground_contact_time = _hold(c.ground_contact_time, contact, dt)
    c.ground_contact = 1 if c.ground_contact_time >= third else 0
    c.maybe_landed_time = _hold(c.maybe_landed_time, c.ground_contact == 1 and still, dt)
    c.maybe_landed = 1 if c.maybe_landed_time >= third else 0
    c.landed_time = _hold(c.landed_time, c.maybe_landed == 1, dt)
    c.landed = 1 if c.landed_time >= third else 0
