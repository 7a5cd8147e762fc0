"""The autopilot of a simplified vehicle: PX4's modes to the extent needed by formation flight and user commands.

OFFBOARD follows the setpoint; AUTO.LOITER and POSCTL hold position; AUTO.TAKEOFF climbs to 2.5 m above the place of
arming and changes to AUTO.LOITER; AUTO.LAND descends; AUTO.RTL climbs, flies home and lands. On the ground a vehicle
is disarmed 3 s after landing, or 10 s after arming if it has not taken off. A setpoint holds until the next one;
topics.py handles setpoint streams that stop. The names in brackets are PX4's parameters.
"""

from __future__ import annotations

import math

from xtdrone_common import modes
from xtdrone_swarm.kernel import kernel
from xtdrone_swarm.swarm_vehicles import ACCELERATION, VELOCITY

OFFBOARD, LOITER, POSCTL, TAKEOFF, LAND, RTL = 0, 1, 2, 3, 4, 5
MODES = (modes.OFFBOARD, modes.AUTO_LOITER, modes.POSCTL, modes.AUTO_TAKEOFF, modes.AUTO_LAND, modes.AUTO_RTL)
MODE_NAMES = tuple(mode.name for mode in MODES)
NO_ARMING = (LAND, RTL)
"""Modes in which PX4 does not arm."""

TAKEOFF_HEIGHT = 2.5  # m (MIS_TAKEOFF_ALT)
_TAKEOFF_SPEED = 1.5  # m/s (MPC_TKO_SPEED)
_SPOOL_UP = 1.0  # s (COM_SPOOLUP_TIME)
_REACHED = 0.2  # m
_CRUISE = 5.0  # m/s (MPC_XY_CRUISE)
_SINK = 1.5  # m/s (MPC_Z_V_AUTO_DN)
_LAND_SPEED = 0.7  # m/s (MPC_LAND_SPEED), below
_SLOW_BELOW = 5.0  # m (MPC_LAND_ALT2); the sink rate fades from its usual value
_FAST_ABOVE = 10.0  # m (MPC_LAND_ALT1)
_RETURN_HEIGHT = 30.0  # m over home (RTL_RETURN_ALT)
_NEAR_HOME = 10.0  # m (RTL_MIN_DIST): closer to home the vehicle does not climb
_HOME_REACHED = 0.5  # m
_LANDED = 3.0  # s from touchdown to disarming: LNDMC_TRIG_TIME and COM_DISARM_LAND
_NEVER_FLOWN = 10.0  # s (COM_DISARM_PRFLT)

_CLIMB, _RETURN, _DESCENT = 0, 1, 2  # phases of RTL


@kernel
def limit_length(x, y, limit):
    """Return the vector (x, y) with its length limited to ``limit``."""
    length = math.sqrt(x * x + y * y)
    if length <= limit:
        return x, y
    return x * limit / length, y * limit / length


@kernel
def enter(v, mode):
    """Enter a flight mode without changing the motion; the current position is the one to hold."""
    v.mode = mode
    v.phase = v.phase_steps = 0
    for k in range(3):
        v.place[k] = v.position[k]


@kernel
def brake(v, m):
    """Set the position to hold to the point where the vehicle comes to rest, as PX4 does in AUTO.LOITER."""
    if m.order == 2:
        for k in range(3):
            axis = 0 if k < 2 else 1
            v.place[k] = v.position[k] + v.velocity[k] * m.time_constant[axis]
        v.place[2] = max(v.place[2], 0.0)


@kernel
def arm(v):
    """Arm a vehicle on the ground and set the home position there."""
    v.armed = 1
    v.rest_steps = v.flown = v.phase = v.phase_steps = 0
    for k in range(3):
        v.home[k] = v.place[k] = v.position[k]


@kernel
def disarm(v):
    """Disarm a vehicle on the ground and return to AUTO.LOITER, PX4's mode after the start."""
    v.armed = 0
    v.mode = LOITER
    v.rest_steps = v.flown = 0
    v.wanted_kind = VELOCITY
    for k in range(3):
        v.velocity[k] = v.wanted[k] = 0.0


@kernel
def _want(v, m, kind, x, y, z):
    """Command a velocity, limited to the vehicle's maximum, or an acceleration."""
    if kind == VELOCITY:
        x, y = limit_length(x, y, m.speed)
        z = min(max(z, -m.speed_down), m.speed_up)
    v.wanted[0], v.wanted[1], v.wanted[2] = x, y, z
    v.wanted_kind = kind


@kernel
def _go_to(v, m, goal, speed, up, down):
    """Command a velocity towards ``goal``, proportional to the distance and limited to the given speeds."""
    x, y = limit_length(m.gain[0] * (goal[0] - v.position[0]), m.gain[0] * (goal[1] - v.position[1]), speed)
    z = min(max(m.gain[1] * (goal[2] - v.position[2]), -down), up)
    _want(v, m, VELOCITY, x, y, z)


@kernel
def _offboard(v, m):
    if v.kind == VELOCITY or v.kind == ACCELERATION:
        _want(v, m, v.kind, v.setpoint[0], v.setpoint[1], v.setpoint[2])
    else:
        _go_to(v, m, v.setpoint, m.speed, m.speed_up, m.speed_down)


@kernel
def _take_off(v, m, dt):
    """Spool up and climb; return whether the takeoff altitude is reached, which ends the mode."""
    v.phase_steps += 1
    if v.position[2] <= 0.0 and v.phase_steps * dt <= _SPOOL_UP:
        _want(v, m, VELOCITY, 0.0, 0.0, 0.0)
        return False
    v.place[2] = max(v.home[2] + TAKEOFF_HEIGHT, v.place[2])
    _go_to(v, m, v.place, _CRUISE, _TAKEOFF_SPEED, _SINK)
    if v.position[2] < v.place[2] - _REACHED:
        return False
    v.mode = LOITER
    return True


@kernel
def _land(v, m):
    """Hold the horizontal position and descend, more slowly near the ground."""
    share = min(max((v.position[2] - _SLOW_BELOW) / (_FAST_ABOVE - _SLOW_BELOW), 0.0), 1.0)
    _go_to(v, m, v.place, _CRUISE, 0.0, 0.0)
    _want(v, m, VELOCITY, v.wanted[0], v.wanted[1], -(_LAND_SPEED + share * (_SINK - _LAND_SPEED)))


@kernel
def _return_home(v, m):
    """Climb, fly to the home position and land there."""
    dx, dy = v.home[0] - v.position[0], v.home[1] - v.position[1]
    away = math.sqrt(dx * dx + dy * dy)
    if v.phase == _CLIMB:
        height = v.home[2] + _RETURN_HEIGHT if away > _NEAR_HOME else v.position[2]
        v.place[2] = max(v.place[2], height)
        if v.position[2] > v.place[2] - _REACHED:
            v.phase = _RETURN
            v.place[0], v.place[1] = v.home[0], v.home[1]
    if v.phase == _RETURN and away < _HOME_REACHED:
        v.phase = _DESCENT
    if v.phase == _DESCENT:
        _land(v, m)
    else:
        _go_to(v, m, v.place, _CRUISE, m.speed_up, _SINK)


@kernel
def _rest(v, dt):
    """Count the time on the ground and disarm after the timeout; return whether the vehicle was disarmed."""
    if v.position[2] > 0.0:
        v.flown = 1
    if v.position[2] > 0.0 or v.wanted[2] > 0.0:
        v.rest_steps = 0
        return False
    v.rest_steps += 1
    if v.rest_steps * dt < (_LANDED if v.flown else _NEVER_FLOWN):
        return False
    disarm(v)
    return True


@kernel
def fly(v, m, dt):
    """Set ``v.wanted`` for the next base step; return whether mode or arming state has changed.

    Args:
        v: ``VEHICLE`` record of kinematics.py.
        m: ``MODEL`` record.
        dt: base step, s.
    """
    if not v.armed:
        return False
    changed = False
    if v.mode == OFFBOARD:
        _offboard(v, m)
    elif v.mode == TAKEOFF:
        changed = _take_off(v, m, dt)
    elif v.mode == LAND:
        _land(v, m)
    elif v.mode == RTL:
        _return_home(v, m)
    else:
        _go_to(v, m, v.place, m.speed, m.speed_up, m.speed_down)
    return _rest(v, dt) or changed
