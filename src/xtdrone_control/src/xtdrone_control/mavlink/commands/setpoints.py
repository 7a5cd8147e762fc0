"""From MAVLink's setpoint messages to the commander's setpoints, as PX4 v1.14's ``mavlink_receiver.cpp`` has it.

A field that its message's mask ignores, and one that is NaN, is not controlled. Every setpoint that says something
keeps OFFBOARD alive, also one that cannot be flown; what PX4 refuses does not. A force, which it does not
fly, it refuses; those above (takeoff, land, loiter, idle) it does not look at, nor do we.

Taken beyond PX4: BODY_OFFSET_NED, in which XTDrone's ``cmd_pose_flu`` asks for an offset from the vehicle; PX4 v1.14
takes LOCAL_NED and BODY_NED alone. SET_ACTUATOR_CONTROL_TARGET is not taken: PX4 refuses it in lockstep with a
simulator.
"""

from __future__ import annotations

import math
from typing import Any

from xtdrone_control import rotation
from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.autopilot.commander.inputs import SetpointError
from xtdrone_control.autopilot.vehicle_view import Vector

_NAN = math.nan
_UNSET = (_NAN, _NAN, _NAN)

# POSITION_TARGET_TYPEMASK
_POSITION, _VELOCITY, _ACCELERATION = 0, 3, 6  # first of three bits each
_ALL = 0b111
_FORCE_BIT, _YAW_BIT, _YAW_RATE_BIT = 9, 10, 11
# ATTITUDE_TARGET_TYPEMASK
_RATE_BITS, _YAW_RATE_IGNORED, _THRUST_BODY, _NO_THRUST, _NO_ATTITUDE = 0b011, 0b100, 0x20, 0x40, 0x80

# MAV_FRAME
_LOCAL_NED, _BODY_NED, _BODY_OFFSET_NED = 1, 8, 9
_GLOBAL, _RELATIVE, _TERRAIN = 5, 6, 11


class RefusedSetpointError(SetpointError):
    """A setpoint that PX4 refuses aloud; its text goes to the operator."""


def _used(mask: int, bit: int, value: float) -> float:
    """Return ``value``, NaN when ``mask`` ignores it."""
    return _NAN if mask >> bit & 1 else value


def _vector(mask: int, first_bit: int, x: float, y: float, z: float) -> Vector:
    return _used(mask, first_bit, x), _used(mask, first_bit + 1, y), _used(mask, first_bit + 2, z)


def _whole_vector(mask: int, first_bit: int, x: float, y: float, z: float) -> Vector:
    """Return the vector, unset when ``mask`` ignores any part of it."""
    return _UNSET if mask >> first_bit & _ALL else (x, y, z)


def _turned(vector: Vector, yaw: float) -> Vector:
    """Return a vector of the heading's frame (forward, right, down) in NED."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y, z = vector
    return cos * x - sin * y, sin * x + cos * y, z


def _is_set(vector: Vector) -> bool:
    return not all(map(math.isnan, vector))


def _refuse_force(mask: int, acceleration: Vector, name: str) -> None:
    """Refuse an "acceleration" that is a force.

    Raises:
        RefusedSetpointError: it is one.
    """
    if mask >> _FORCE_BIT & 1 and _is_set(acceleration):
        raise RefusedSetpointError(f"{name} force not supported")


def _yaw_and_rate(m: Any) -> tuple[float, float]:
    return _used(m.type_mask, _YAW_BIT, m.yaw), _used(m.type_mask, _YAW_RATE_BIT, m.yaw_rate)


def local_target(commander: Commander, m: Any) -> None:
    """Take SET_POSITION_TARGET_LOCAL_NED.

    LOCAL_NED is as given. BODY_NED has no position; its velocity is turned by the heading, its acceleration by the
    whole attitude, each only when all its three parts are used; its yaw counts from north. In BODY_OFFSET_NED position
    and yaw count from the vehicle, and all is turned by the heading.

    Raises:
        RefusedSetpointError: another frame, a force, or nothing set.
    """
    name = "SET_POSITION_TARGET_LOCAL_NED"
    frame, mask = m.coordinate_frame, m.type_mask
    yaw, yaw_rate = _yaw_and_rate(m)
    if frame == _LOCAL_NED:
        position = _vector(mask, _POSITION, m.x, m.y, m.z)
        velocity = _vector(mask, _VELOCITY, m.vx, m.vy, m.vz)
        acceleration = _vector(mask, _ACCELERATION, m.afx, m.afy, m.afz)
    elif frame == _BODY_NED:
        q0, q1, q2, q3 = commander.view.estimator["q"].tolist()
        position = _UNSET
        velocity = _turned(_whole_vector(mask, _VELOCITY, m.vx, m.vy, m.vz), commander.view.yaw)
        acceleration = rotation.rotate((q0, q1, q2, q3), *_whole_vector(mask, _ACCELERATION, m.afx, m.afy, m.afz))
    elif frame == _BODY_OFFSET_NED:
        heading = commander.view.yaw
        x, y, z = _turned(_vector(mask, _POSITION, m.x, m.y, m.z), heading)
        here = commander.view.position
        position = (here[0] + x, here[1] + y, here[2] + z)
        velocity = _turned(_vector(mask, _VELOCITY, m.vx, m.vy, m.vz), heading)
        acceleration = _turned(_vector(mask, _ACCELERATION, m.afx, m.afy, m.afz), heading)
        yaw = math.remainder(yaw + heading, math.tau) if math.isfinite(yaw) else _NAN
    else:
        raise RefusedSetpointError(f"{name} coordinate frame {frame} unsupported")
    _refuse_force(mask, acceleration, name)
    if not (_is_set(position) or _is_set(velocity) or _is_set(acceleration)):
        raise RefusedSetpointError(f"{name} invalid")
    commander.offboard_trajectory(position, velocity, acceleration, yaw, yaw_rate)


def global_target(commander: Commander, m: Any) -> None:
    """Take SET_POSITION_TARGET_GLOBAL_INT: its position when no part of it is ignored, with altitude over sea or home.

    Raises:
        RefusedSetpointError: a position in another frame, or a force.
        SetpointError: a place that is none, an altitude over what is not known, or nothing set.
    """
    name = "SET_POSITION_TARGET_GLOBAL_INT"
    mask = m.type_mask
    position = _UNSET if mask >> _POSITION & _ALL else _global_position(commander, m, name)
    velocity = _vector(mask, _VELOCITY, m.vx, m.vy, m.vz)
    acceleration = _vector(mask, _ACCELERATION, m.afx, m.afy, m.afz)
    _refuse_force(mask, acceleration, name)
    commander.offboard_trajectory(position, velocity, acceleration, *_yaw_and_rate(m))


def _global_position(commander: Commander, m: Any, name: str) -> Vector:
    frame, altitude = m.coordinate_frame, m.alt
    if not commander.view.has_origin:
        raise SetpointError(f"{name}: where the local frame lies on Earth is not known")
    if frame == _RELATIVE:
        if commander.home is None:
            raise SetpointError(f"{name}: altitude over home, and there is no home yet")
        altitude += commander.home.altitude
    elif frame == _TERRAIN:
        raise SetpointError(f"{name}: altitude over terrain, whose height is not known")
    elif frame != _GLOBAL:
        raise RefusedSetpointError(f"{name} invalid coordinate frame {frame}")
    latitude, longitude = m.lat_int * 1e-7, m.lon_int * 1e-7
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        raise SetpointError(f"{name}: latitude {latitude:.7f}, longitude {longitude:.7f} are no place")
    return commander.view.to_local(latitude, longitude, altitude)


def attitude_target(commander: Commander, m: Any) -> None:
    """Take SET_ATTITUDE_TARGET: an attitude with an optional yaw rate, or body rates of which yaw's may be left out.

    Thrust that is ignored is none; an attitude may have it as a body vector, of which the part along -z is flown. A
    message with neither attitude nor roll and pitch rate says nothing.

    Raises:
        SetpointError: an attitude that is none.
    """
    mask = m.type_mask
    yaw_rate = _NAN if mask & _YAW_RATE_IGNORED else m.body_yaw_rate
    thrust = 0.0 if mask & _NO_THRUST else m.thrust
    if not mask & _NO_ATTITUDE:
        commander.offboard_attitude(m.q, yaw_rate, -m.thrust_body[2] if mask & _THRUST_BODY else thrust)
    elif not mask & _RATE_BITS:
        commander.offboard_rates((m.body_roll_rate, m.body_pitch_rate, yaw_rate), thrust)
