"""Setpoints of the communication layer, in the form of mavros_msgs/PositionTarget; independent of ROS.

As in MAVROS, the *number* in ``coordinate_frame`` is MAVLink's (1 LOCAL_NED, 8 BODY_NED, 9 BODY_OFFSET_NED), but the
*values* are ENU for frame 1 and FLU for frames 8 and 9; MAVROS converts them to NED and FRD.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Vector = tuple[float, float, float]

FRAME_LOCAL_NED = 1
FRAME_BODY_NED = 8
FRAME_BODY_OFFSET_NED = 9

IGNORE_POSITION = 1 | 2 | 4
IGNORE_VELOCITY = 8 | 16 | 32
IGNORE_ACCELERATION = 64 | 128 | 256
IGNORE_YAW = 1024
IGNORE_YAW_RATE = 2048

LARGEST = 1e6  # m, m/s, m/s^2, rad/s: MAVLink carries float32, and feasible values are far smaller

_ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Setpoint:
    """One PositionTarget without its header.

    Attributes:
        frame: ``coordinate_frame``, 1, 8 or 9.
        type_mask: bits of the fields to ignore.
        position: m, ENU (frame 1) or FLU offset from the vehicle (frame 9).
        velocity: m/s, ENU (frame 1) or FLU (frame 8).
        acceleration: m/s^2, ENU (frame 1) or FLU (frame 8).
        yaw: rad, ENU (0 is east, counter-clockwise) or FLU offset.
        yaw_rate: rad/s, counter-clockwise.
    """

    frame: int
    type_mask: int
    position: Vector = _ZERO
    velocity: Vector = _ZERO
    acceleration: Vector = _ZERO
    yaw: float = 0.0
    yaw_rate: float = 0.0


def pose_setpoint(position: Vector, yaw: float, *, body: bool) -> Setpoint:
    """Return a setpoint of position (m) and yaw (rad): ENU in the local frame, or a FLU offset if ``body``."""
    frame = FRAME_BODY_OFFSET_NED if body else FRAME_LOCAL_NED
    mask = IGNORE_VELOCITY | IGNORE_ACCELERATION | IGNORE_YAW_RATE
    return Setpoint(frame, mask, position=position, yaw=yaw)


def velocity_setpoint(velocity: Vector, yaw_rate: float, *, body: bool) -> Setpoint:
    """Return a setpoint of velocity (m/s) and yaw rate (rad/s), ENU, or FLU if ``body``."""
    frame = FRAME_BODY_NED if body else FRAME_LOCAL_NED
    mask = IGNORE_POSITION | IGNORE_ACCELERATION | IGNORE_YAW
    return Setpoint(frame, mask, velocity=velocity, yaw_rate=yaw_rate)


def acceleration_setpoint(acceleration: Vector, yaw_rate: float, *, body: bool) -> Setpoint:
    """Return a setpoint of acceleration (m/s^2) and yaw rate (rad/s), ENU, or FLU if ``body``."""
    frame = FRAME_BODY_NED if body else FRAME_LOCAL_NED
    mask = IGNORE_POSITION | IGNORE_VELOCITY | IGNORE_YAW
    return Setpoint(frame, mask, acceleration=acceleration, yaw_rate=yaw_rate)


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Return the yaw in radians of a quaternion (x, y, z, w) of any length; 0 for the all-zero one.

    An unset geometry_msgs/Pose has the all-zero quaternion, and users leave it unset to mean "no rotation".
    """
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def first_bad_field(names: Sequence[str], values: Sequence[float]) -> str | None:
    """Return ``"name is value"`` for the first value that is NaN, infinite or beyond +-1e6; None if all are valid."""
    if sum(map(abs, values)) <= LARGEST:  # then each value is at most LARGEST
        return None
    for name, value in zip(names, values, strict=True):
        if not abs(value) <= LARGEST:  # written so that NaN fails too
            return f"{name} is {value}"
    return None
