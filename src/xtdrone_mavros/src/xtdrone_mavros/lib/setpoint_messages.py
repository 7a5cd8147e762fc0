"""MAVLink's setpoint messages from ENU and FLU, shared by the setpoint plugins."""

from __future__ import annotations

from collections.abc import Iterable
from math import isfinite
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common import frames
from xtdrone_mavros.link.ros_values_to_mavlink import FLOAT32_MAX, whole
from xtdrone_mavros.uas import Uas

# Frames with vectors in FLU (ROS) and FRD (MAVLink); in all others they are ENU and NED.
BODY_FRAMES = frozenset({mavlink.MAV_FRAME_BODY_NED, mavlink.MAV_FRAME_BODY_OFFSET_NED})

# type_mask of MAVROS's setpoint plugins: the ignored fields
ONLY_POSITION_YAW = 1 << 11 | 7 << 6 | 7 << 3
ONLY_VELOCITY_YAW_RATE = 1 << 10 | 7 << 6 | 7 << 0
ONLY_ACCELERATION = 3 << 10 | 7 << 3 | 7 << 0
ONLY_GLOBAL_POSITION_YAW = 7 << 6 | 7 << 3  # also commands a yaw rate of 0
FORCE = 1 << 9  # the acceleration is a force
ONLY_ATTITUDE_THRUST = 7 << 0
ONLY_RATES_THRUST = 1 << 7

_ZERO = (0.0, 0.0, 0.0)
_LATITUDE, _LONGITUDE = 1, 2  # bits of the mask


def position_target(
    uas: Uas,
    time_boot_ms: int,
    frame: int,
    type_mask: int,
    position: frames.Vector = _ZERO,
    velocity: frames.Vector = _ZERO,
    acceleration: frames.Vector = _ZERO,
    yaw: float = 0.0,
    yaw_rate: float = 0.0,
) -> Any:
    """Return the MAVLink setpoint, converted as MAVROS does.

    Args:
        uas: hub of the vehicle.
        time_boot_ms: time stamp of the message, 32 bit.
        frame: MAV_FRAME; in BODY_NED and BODY_OFFSET_NED vectors are FLU and the yaw is relative (its sign changes), in
            others vectors are ENU and the yaw is measured from east.
        type_mask: POSITION_TARGET_TYPEMASK.
        position: m.
        velocity: m/s.
        acceleration: m/s^2.
        yaw: rad, counter-clockwise.
        yaw_rate: rad/s, counter-clockwise.
    """
    if frame in BODY_FRAMES:
        change, target_yaw = frames.flu_to_frd, -yaw
    else:
        change, target_yaw = frames.enu_to_ned, frames.yaw_enu_to_ned(yaw) if isfinite(yaw) else yaw
    system, component = uas.target
    return mavlink.MAVLink_set_position_target_local_ned_message(
        time_boot_ms,
        system,
        component,
        frame,
        type_mask,
        *change(*position),
        *change(*velocity),
        *change(*acceleration),
        target_yaw,
        -yaw_rate,
    )


def global_target(
    uas: Uas,
    time_boot_ms: int,
    frame: int,
    type_mask: int,
    place: frames.Vector,
    velocity: frames.Vector = _ZERO,
    acceleration: frames.Vector = _ZERO,
    yaw: float = 0.0,
    yaw_rate: float = 0.0,
) -> Any:
    """Return SET_POSITION_TARGET_GLOBAL_INT, converted as MAVROS does.

    Args:
        uas: hub of the vehicle.
        time_boot_ms: time stamp of the message, 32 bit.
        frame: MAV_FRAME, which determines the reference of the altitude.
        type_mask: POSITION_TARGET_TYPEMASK.
        place: latitude, longitude (deg), altitude (m); a masked-out latitude or longitude may be NaN.
        velocity: m/s, ENU.
        acceleration: m/s^2, ENU.
        yaw: rad, counter-clockwise from east.
        yaw_rate: rad/s, counter-clockwise.
    """
    latitude, longitude, altitude = place
    return mavlink.MAVLink_set_position_target_global_int_message(
        time_boot_ms,
        *uas.target,
        frame,
        type_mask,
        0 if type_mask & _LATITUDE else whole(latitude * 1e7),
        0 if type_mask & _LONGITUDE else whole(longitude * 1e7),
        altitude,
        *frames.enu_to_ned(*velocity),
        *frames.enu_to_ned(*acceleration),
        frames.yaw_enu_to_ned(yaw) if isfinite(yaw) else yaw,
        -yaw_rate,
    )


def attitude_target(
    uas: Uas,
    time_boot_ms: int,
    type_mask: int,
    thrust: float,
    attitude: frames.Quaternion = (1.0, 0.0, 0.0, 0.0),
    rates: frames.Vector = _ZERO,
) -> Any:
    """Return SET_ATTITUDE_TARGET, converted as MAVROS does.

    Args:
        uas: hub of the vehicle.
        time_boot_ms: time stamp of the message, 32 bit.
        type_mask: ATTITUDE_TARGET_TYPEMASK.
        thrust: collective, 0..1 (-1..1 for a vehicle that can reverse).
        attitude: FLU to ENU (w, x, y, z).
        rates: body rates, rad/s, FLU.
    """
    return mavlink.MAVLink_set_attitude_target_message(
        time_boot_ms,
        *uas.target,
        type_mask,
        list(frames.attitude_enu_to_ned(*attitude)),
        *frames.flu_to_frd(*rates),
        thrust,
    )


def certainly_finite(numbers: Iterable[float]) -> bool:
    """Return whether the sum of the absolute values fits into a 32-bit float, as it does for any sensible setpoint."""
    return sum(map(abs, numbers)) <= FLOAT32_MAX


def xyz(vector: Any) -> frames.Vector:
    """Return x, y and z of a ROS vector or point."""
    return vector.x, vector.y, vector.z


def set_xyz(vector: Any, values: frames.Vector) -> None:
    """Set x, y and z of a ROS vector or point."""
    vector.x, vector.y, vector.z = values


def vector_fields(name: str, vector: Any, axes: str = "xyz") -> list[tuple[str, float]]:
    """Return (field, value) pairs of a ROS vector or quaternion in field ``name`` of a message, for ``Uas.finite``."""
    return [(f"{name}.{axis}", getattr(vector, axis)) for axis in axes]
