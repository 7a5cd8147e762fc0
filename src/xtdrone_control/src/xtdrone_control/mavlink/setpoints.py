"""From MAVLink's set-point messages to the commander's set-points: masks, frames, units."""

from __future__ import annotations

import math
from typing import Any

from xtdrone_control.autopilot.commander import Commander
from xtdrone_control.autopilot.inputs import SetpointError
from xtdrone_control.autopilot.vehicle_view import Vector

_NAN = math.nan
_UNSET = (_NAN, _NAN, _NAN)

# POSITION_TARGET_TYPEMASK: bits 0..2 position, 3..5 velocity, 6..8 acceleration
_FORCE_BIT, _YAW_BIT, _YAW_RATE_BIT = 9, 10, 11
# ATTITUDE_TARGET_TYPEMASK
_RATE_BITS, _THRUST_BIT, _ATTITUDE_BIT = (0, 1, 2), 6, 7

# MAV_FRAME
_LOCAL_NED, _LOCAL_OFFSET_NED, _BODY_NED, _BODY_OFFSET_NED, _BODY_FRD = 1, 7, 8, 9, 12
_LOCAL_FRAMES = (_LOCAL_NED, _LOCAL_OFFSET_NED, _BODY_NED, _BODY_OFFSET_NED, _BODY_FRD)
_HEADING_FRAMES = (_BODY_NED, _BODY_OFFSET_NED, _BODY_FRD)
_AMSL_FRAMES, _RELATIVE_FRAMES = (0, 5), (3, 6)

_STICK_RANGE = 1000.0
_STICK_UNUSED = 32767


def _used(mask: int, first_bit: int, name: str, *values: float) -> tuple[float, ...]:
    """Return ``values`` with NaN for those that ``mask`` ignores.

    Raises:
        SetpointError: a value that is used is not finite.
    """
    result = []
    for bit, value in enumerate(values, first_bit):
        if mask >> bit & 1:
            result.append(_NAN)
        elif math.isfinite(value):
            result.append(value)
        else:
            raise SetpointError(f"{name} is {value}, not a finite number")
    return tuple(result)


def _vector(mask: int, first_bit: int, name: str, x: float, y: float, z: float) -> Vector:
    a, b, c = _used(mask, first_bit, name, x, y, z)
    return a, b, c


def _turned(vector: Vector, yaw: float) -> Vector:
    """Return a vector of the heading's frame (forward, right, down) in NED."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y, z = vector
    return cos * x - sin * y, sin * x + cos * y, z


def _sum(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _common_parts(message: Any) -> tuple[Vector, Vector, float, float]:
    """Return velocity, acceleration, yaw and yaw rate of a position target, NaN where it ignores them."""
    mask, m = message.type_mask, message
    acceleration = _vector(mask, 6, "acceleration", m.afx, m.afy, m.afz)
    if mask >> _FORCE_BIT & 1 and any(map(math.isfinite, acceleration)):
        raise SetpointError("force is not supported, acceleration is")
    velocity = _vector(mask, 3, "velocity", m.vx, m.vy, m.vz)
    (yaw,) = _used(mask, _YAW_BIT, "yaw", m.yaw)
    (yaw_rate,) = _used(mask, _YAW_RATE_BIT, "yaw rate", m.yaw_rate)
    return velocity, acceleration, yaw, yaw_rate


def local_target(commander: Commander, m: Any) -> None:
    """Take SET_POSITION_TARGET_LOCAL_NED.

    LOCAL_NED is as given. LOCAL_OFFSET_NED's position counts from where the vehicle is. In the body frames velocity and
    acceleration are turned by the heading, in BODY_OFFSET_NED and BODY_FRD position and yaw count from the vehicle;
    BODY_NED takes no position and has its yaw from north, as in PX4.

    Raises:
        SetpointError: a set-point that cannot be flown.
    """
    frame = m.coordinate_frame
    if frame not in _LOCAL_FRAMES:
        raise SetpointError(f"frame {frame} is not supported, allowed: {', '.join(map(str, _LOCAL_FRAMES))}")
    position = _vector(m.type_mask, 0, "position", m.x, m.y, m.z)
    velocity, acceleration, yaw, yaw_rate = _common_parts(m)
    if frame in _HEADING_FRAMES:
        heading = commander.view.yaw
        velocity, acceleration = _turned(velocity, heading), _turned(acceleration, heading)
        position = _UNSET if frame == _BODY_NED else _turned(position, heading)
        if frame != _BODY_NED:
            yaw = math.remainder(yaw + heading, math.tau)
    if frame in (_LOCAL_OFFSET_NED, _BODY_OFFSET_NED, _BODY_FRD):
        position = _sum(position, commander.view.position)
    commander.offboard_trajectory(position, velocity, acceleration, yaw, yaw_rate)


def global_target(commander: Commander, m: Any) -> None:
    """Take SET_POSITION_TARGET_GLOBAL_INT, with altitude over sea or over home.

    Raises:
        SetpointError: a set-point that cannot be flown.
    """
    frame, mask = m.coordinate_frame, m.type_mask
    if frame not in _AMSL_FRAMES + _RELATIVE_FRAMES:
        raise SetpointError(f"frame {frame} is not supported, allowed: 0, 3, 5, 6")
    lat, lon, alt = _vector(mask, 0, "position", m.lat_int * 1e-7, m.lon_int * 1e-7, m.alt)
    if abs(lat) > 90.0 or abs(lon) > 180.0:
        raise SetpointError(f"latitude {lat:.7f}, longitude {lon:.7f} are no place")
    if frame in _RELATIVE_FRAMES:
        if commander.home is None:
            raise SetpointError("altitude over home: there is no home yet")
        alt += commander.home.altitude
    velocity, acceleration, yaw, yaw_rate = _common_parts(m)
    position = commander.view.to_local(lat, lon, alt)
    commander.offboard_trajectory(position, velocity, acceleration, yaw, yaw_rate)


def attitude_target(commander: Commander, m: Any) -> None:
    """Take SET_ATTITUDE_TARGET: attitude with an optional yaw rate, or body rates, and thrust.

    Raises:
        SetpointError: a set-point that cannot be flown.
    """
    mask = m.type_mask
    if mask >> _THRUST_BIT & 1:
        raise SetpointError("attitude target without thrust")
    rates = (m.body_roll_rate, m.body_pitch_rate, m.body_yaw_rate)
    if not mask >> _ATTITUDE_BIT & 1:
        yaw_rate = _NAN if mask >> 2 & 1 else rates[2]
        commander.offboard_attitude(m.q, yaw_rate, m.thrust)
    elif any(mask >> bit & 1 for bit in _RATE_BITS):
        raise SetpointError("attitude target without attitude and without all body rates")
    else:
        commander.offboard_rates(rates, m.thrust)


def sticks(commander: Commander, m: Any) -> None:
    """Take MANUAL_CONTROL: x, y, r of -1000..1000, z of 0..1000 with 500 in the middle."""
    x, y, yaw = (0.0 if v == _STICK_UNUSED else v / _STICK_RANGE for v in (m.x, m.y, m.r))
    z = 0.0 if m.z == _STICK_UNUSED else 2.0 * m.z / _STICK_RANGE - 1.0
    commander.manual_control(x, y, z, yaw)
