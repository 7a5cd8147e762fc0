"""Conversion of setpoints to velocities, and of corrected velocities to setpoints; messages are filled in place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from xtdrone_common.rotation import wrap_pi
from xtdrone_control.communication.setpoint import (
    FRAME_BODY_NED,
    FRAME_BODY_OFFSET_NED,
    FRAME_LOCAL_NED,
    IGNORE_ACCELERATION,
    IGNORE_POSITION,
    IGNORE_VELOCITY,
    IGNORE_YAW,
    IGNORE_YAW_RATE,
    Vector,
    yaw_of,
)

_FORCE = 512
_UNSET_FRAME = 0  # counts as LOCAL_NED in MAVROS
_POSITION_BITS, _VELOCITY_BITS, _ACCELERATION_BITS = (1, 2, 4), (8, 16, 32), (64, 128, 256)


@dataclass(frozen=True)
class VehicleMotion:
    """State of the filtered vehicle.

    Attributes:
        position: m ENU.
        velocity: m/s ENU.
        yaw: rad ENU.
    """

    position: Vector
    velocity: Vector
    yaw: float


@dataclass(frozen=True)
class Meaning:
    """VehicleMotion demanded by a setpoint.

    Attributes:
        velocity: m/s ENU.
        yaw: rad ENU, None: not controlled.
        yaw_rate: rad/s, counter-clockwise, None: not controlled.
        position: m ENU, None: not controlled.
    """

    velocity: Vector
    yaw: float | None = None
    yaw_rate: float | None = None
    position: Vector | None = None


@dataclass(frozen=True)
class Gains:
    """Gains that convert position and acceleration setpoints to velocities.

    Attributes:
        kp: speed per position error, 1/s.
        lag: time for which an acceleration is applied, s.
        max_speed: towards a position, m/s.
    """

    kp: float
    lag: float
    max_speed: float


def meaning_of_target(target: Any, motion: VehicleMotion, gains: Gains) -> Meaning | None:
    """Return the meaning of a mavros_msgs/PositionTarget; None if it cannot be checked, e.g. a force."""
    mask, frame = target.type_mask, target.coordinate_frame or FRAME_LOCAL_NED
    nothing = IGNORE_POSITION | IGNORE_VELOCITY | IGNORE_ACCELERATION
    if frame not in (FRAME_LOCAL_NED, FRAME_BODY_NED, FRAME_BODY_OFFSET_NED) or mask & nothing == nothing:
        return None
    if mask & _FORCE and mask & IGNORE_ACCELERATION != IGNORE_ACCELERATION:
        return None
    body = frame != FRAME_LOCAL_NED
    position, velocity, acceleration = (
        _level(_numbers(vector, mask, bits), motion.yaw) if body else _numbers(vector, mask, bits)
        for vector, bits in (
            (target.position, _POSITION_BITS),
            (target.velocity, _VELOCITY_BITS),
            (target.acceleration_or_force, _ACCELERATION_BITS),
        )
    )
    if body:  # an offset from the vehicle
        position = tuple(p + x for p, x in zip(position, motion.position, strict=True))  # type: ignore[assignment]
    wanted = []
    for axis in range(3):
        if not mask & _POSITION_BITS[axis]:
            wanted.append(gains.kp * (position[axis] - motion.position[axis]) + velocity[axis])
        elif not mask & _VELOCITY_BITS[axis]:
            wanted.append(velocity[axis])
        else:
            wanted.append(motion.velocity[axis] + gains.lag * acceleration[axis])
    if mask & IGNORE_POSITION != IGNORE_POSITION:
        wanted = list(_limit(wanted, gains.max_speed))
    yaw = None if mask & IGNORE_YAW else wrap_pi(target.yaw + motion.yaw * body)
    yaw_rate = None if mask & IGNORE_YAW_RATE else target.yaw_rate
    place = None if mask & IGNORE_POSITION else position
    return _finite(Meaning(tuple(wanted), yaw, yaw_rate, place))  # type: ignore[arg-type]


def meaning_of_pose(pose: Any, motion: VehicleMotion, gains: Gains) -> Meaning | None:
    """Return the meaning of a geometry_msgs/Pose on setpoint_position/local; None if it is not finite."""
    p, q = pose.position, pose.orientation
    way = (gains.kp * (a - x) for a, x in zip((p.x, p.y, p.z), motion.position, strict=True))
    velocity = _limit(list(way), gains.max_speed)
    return _finite(Meaning(velocity, yaw_of(q.x, q.y, q.z, q.w), position=(p.x, p.y, p.z)))  # type: ignore[arg-type]


def meaning_of_twist(twist: Any) -> Meaning | None:
    """Return the meaning of a geometry_msgs/Twist on setpoint_velocity (LOCAL_NED); None if it is not finite."""
    v = twist.linear
    return _finite(Meaning((v.x, v.y, v.z), None, twist.angular.z))


def meaning_of_acceleration(vector: Any, motion: VehicleMotion, gains: Gains) -> Meaning | None:
    """Return the meaning of a geometry_msgs/Vector3 on setpoint_accel/accel; None if it is not finite."""
    accelerations = zip(motion.velocity, (vector.x, vector.y, vector.z), strict=True)
    return _finite(Meaning(tuple(v + gains.lag * a for v, a in accelerations)))  # type: ignore[arg-type]


def fill_target(target: Any, velocity: Sequence[float], meaning: Meaning) -> None:
    """Write a velocity (m/s ENU), with the yaw or yaw rate of the meaning, to a PositionTarget, except its header."""
    target.coordinate_frame = FRAME_LOCAL_NED
    target.type_mask = IGNORE_POSITION | IGNORE_ACCELERATION
    if meaning.yaw is None:
        target.type_mask |= IGNORE_YAW
    if meaning.yaw_rate is None:
        target.type_mask |= IGNORE_YAW_RATE
    target.velocity.x, target.velocity.y, target.velocity.z = velocity
    target.yaw, target.yaw_rate = meaning.yaw or 0.0, meaning.yaw_rate or 0.0


def _numbers(vector: Any, mask: int, bits: Sequence[int]) -> Vector:
    """Return a vector with 0 for the ignored fields."""
    x, y, z = (0.0 if mask & bit else value for value, bit in zip((vector.x, vector.y, vector.z), bits, strict=True))
    return x, y, z


def _level(vector: Vector, yaw: float) -> Vector:
    """Rotate a vector from the horizontal body frame to ENU."""
    x, y, z = vector
    return math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y, z


def _limit(vector: list[float], most: float) -> tuple[float, ...]:
    length = math.hypot(*vector)
    return tuple(x * most / length for x in vector) if length > most else tuple(vector)


def _finite(meaning: Meaning) -> Meaning | None:
    return meaning if all(map(math.isfinite, meaning.velocity)) else None
