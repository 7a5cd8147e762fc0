"""Conversion of MAVLink setpoint messages to setpoints of the commander, as in PX4 v1.14's ``mavlink_receiver.cpp``.

Fields that the type mask ignores, and NaN, are not controlled. Every non-empty setpoint refreshes the OFFBOARD timeout,
even an infeasible one; rejected setpoints do not. Force setpoints are rejected. As in PX4, the takeoff, land, loiter
and idle bits of the type mask are ignored.

BODY_OFFSET_NED is accepted beyond PX4 v1.14, which supports only LOCAL_NED and BODY_NED: XTDrone's ``cmd_pose_flu``
uses it for an offset from the vehicle. (PX4 v1.11 treated the position as local, whatever the frame.) XTDrone repeats
the offset at 30 Hz; it is relative to the vehicle's position when the command arrived (``CommandStart``).

SET_ACTUATOR_CONTROL_TARGET is not supported: PX4 rejects it in lockstep with a simulator.
"""

from __future__ import annotations

import math
from typing import Any

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.commander.offboard_setpoint import SetpointError
from xtdrone_autopilot.vehicle_view import Vector
from xtdrone_common import rotation

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
    """A setpoint that PX4 rejects with a STATUSTEXT; the error text is sent to the operators."""


def _used(mask: int, bit: int, value: float) -> float:
    """Return ``value``, NaN if ``mask`` ignores it."""
    return _NAN if mask >> bit & 1 else value


def _vector(mask: int, first_bit: int, x: float, y: float, z: float) -> Vector:
    ignored = mask >> first_bit & _ALL
    if ignored == _ALL:
        return _UNSET
    if not ignored:
        return x, y, z
    return _used(ignored, 0, x), _used(ignored, 1, y), _used(ignored, 2, z)


def _whole_vector(mask: int, first_bit: int, x: float, y: float, z: float) -> Vector:
    """Return the vector, unset if ``mask`` ignores any component."""
    return _UNSET if mask >> first_bit & _ALL else (x, y, z)


def _to_ned(vector: Vector, yaw: float) -> Vector:
    """Rotate a vector from the heading frame (forward, right, down) to NED; ``yaw`` in rad."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y, z = vector
    return cos * x - sin * y, sin * x + cos * y, z


def _is_set(vector: Vector) -> bool:
    x, y, z = vector
    return not (math.isnan(x) and math.isnan(y) and math.isnan(z))


def _reject_force(mask: int, acceleration: Vector, name: str) -> None:
    """Reject an acceleration that the mask declares a force.

    Raises:
        RefusedSetpointError: the setpoint is a force.
    """
    if mask >> _FORCE_BIT & 1 and _is_set(acceleration):
        raise RefusedSetpointError(f"{name} force not supported")


def _yaw_and_rate(m: Any) -> tuple[float, float]:
    return _used(m.type_mask, _YAW_BIT, m.yaw), _used(m.type_mask, _YAW_RATE_BIT, m.yaw_rate)


def local_target(commander: Commander, m: Any) -> None:
    """Apply SET_POSITION_TARGET_LOCAL_NED.

    LOCAL_NED is used unchanged. In BODY_NED the position is ignored, velocity is rotated by the heading and
    acceleration by the attitude, each only if all three components are used; yaw is relative to north. In
    BODY_OFFSET_NED position and yaw are relative to the vehicle at the start of the command, velocity and acceleration
    are rotated by the current heading.

    Raises:
        RefusedSetpointError: another frame, a force, or an empty setpoint.
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
        velocity = _to_ned(_whole_vector(mask, _VELOCITY, m.vx, m.vy, m.vz), commander.view.yaw)
        acceleration = rotation.rotate((q0, q1, q2, q3), *_whole_vector(mask, _ACCELERATION, m.afx, m.afy, m.afz))
    elif frame == _BODY_OFFSET_NED:
        offset = _vector(mask, _POSITION, m.x, m.y, m.z)
        velocity = _vector(mask, _VELOCITY, m.vx, m.vy, m.vz)
        acceleration = _vector(mask, _ACCELERATION, m.afx, m.afy, m.afz)
        start, heading = commander.offboard.offset_start((*offset, *velocity, *acceleration, yaw, yaw_rate))
        x, y, z = _to_ned(offset, heading)
        position = (start[0] + x, start[1] + y, start[2] + z)
        velocity = _to_ned(velocity, commander.view.yaw)
        acceleration = _to_ned(acceleration, commander.view.yaw)
        yaw = math.remainder(yaw + heading, math.tau) if math.isfinite(yaw) else _NAN
    else:
        raise RefusedSetpointError(f"{name} coordinate frame {frame} unsupported")
    _reject_force(mask, acceleration, name)
    if not (_is_set(position) or _is_set(velocity) or _is_set(acceleration)):
        raise RefusedSetpointError(f"{name} invalid")
    commander.offboard.set_trajectory(position, velocity, acceleration, yaw, yaw_rate)


def global_target(commander: Commander, m: Any) -> None:
    """Apply SET_POSITION_TARGET_GLOBAL_INT; its position only if all components are used, altitude AMSL or above home.

    Raises:
        RefusedSetpointError: a position in another frame, or a force.
        SetpointError: an invalid position, an unknown altitude reference, or an empty setpoint.
    """
    name = "SET_POSITION_TARGET_GLOBAL_INT"
    mask = m.type_mask
    position = _UNSET if mask >> _POSITION & _ALL else _global_position(commander, m, name)
    velocity = _vector(mask, _VELOCITY, m.vx, m.vy, m.vz)
    acceleration = _vector(mask, _ACCELERATION, m.afx, m.afy, m.afz)
    _reject_force(mask, acceleration, name)
    commander.offboard.set_trajectory(position, velocity, acceleration, *_yaw_and_rate(m))


def _global_position(commander: Commander, m: Any, name: str) -> Vector:
    frame, altitude = m.coordinate_frame, m.alt
    if not commander.view.has_origin:
        raise SetpointError(f"{name}: the global origin of the local frame is unknown")
    if frame == _RELATIVE:
        if commander.home is None:
            raise SetpointError(f"{name}: altitude above home, but home is not set")
        altitude += commander.home.altitude
    elif frame == _TERRAIN:
        raise SetpointError(f"{name}: altitude above terrain, but the terrain height is unknown")
    elif frame != _GLOBAL:
        raise RefusedSetpointError(f"{name} invalid coordinate frame {frame}")
    latitude, longitude = m.lat_int * 1e-7, m.lon_int * 1e-7
    if abs(latitude) > 90.0 or abs(longitude) > 180.0:
        raise SetpointError(f"{name}: position {latitude:.7f}, {longitude:.7f} is not allowed, +-90, +-180 degrees")
    return commander.view.to_local(latitude, longitude, altitude)


def attitude_target(commander: Commander, m: Any) -> None:
    """Apply SET_ATTITUDE_TARGET: an attitude with an optional yaw rate, or body rates with an optional yaw rate.

    Ignored thrust is 0. With an attitude, thrust may be a body vector, of which only the component along -z is used. A
    message with neither an attitude nor roll and pitch rates is ignored.

    Raises:
        SetpointError: an invalid attitude quaternion.
    """
    mask = m.type_mask
    yaw_rate = _NAN if mask & _YAW_RATE_IGNORED else m.body_yaw_rate
    thrust = 0.0 if mask & _NO_THRUST else m.thrust
    if not mask & _NO_ATTITUDE:
        commander.offboard.set_attitude(m.q, yaw_rate, -m.thrust_body[2] if mask & _THRUST_BODY else thrust)
    elif not mask & _RATE_BITS:
        commander.offboard.set_rates((m.body_roll_rate, m.body_pitch_rate, yaw_rate), thrust)
