"""Conversion of MAVROS setpoints to those of the simplified vehicles. Values are ENU or FLU, as in MAVROS."""

from __future__ import annotations

import math
from typing import NamedTuple

from xtdrone_control.communication.setpoint import (
    FRAME_BODY_NED,
    FRAME_BODY_OFFSET_NED,
    FRAME_LOCAL_NED,
    IGNORE_ACCELERATION,
    IGNORE_POSITION,
    IGNORE_VELOCITY,
    IGNORE_YAW,
    IGNORE_YAW_RATE,
    Setpoint,
    Vector,
    first_bad_field,
)
from xtdrone_swarm.swarm_vehicles import ACCELERATION, POSITION, VELOCITY

FORCE = 512  # type_mask: the acceleration is a force

_FRAMES = {FRAME_LOCAL_NED: "LOCAL_NED", FRAME_BODY_NED: "BODY_NED", FRAME_BODY_OFFSET_NED: "BODY_OFFSET_NED"}
_KINDS = (
    (IGNORE_POSITION, POSITION, "position"),
    (IGNORE_VELOCITY, VELOCITY, "velocity"),
    (IGNORE_ACCELERATION, ACCELERATION, "acceleration_or_force"),
)


class SetpointError(ValueError):
    """A setpoint that the simplified vehicles cannot fly; the message names the unsupported part."""


class Start(NamedTuple):
    """Where a setpoint relative to the vehicle counts from.

    Attributes:
        position: m, ENU.
        heading: rad from east, counter-clockwise.
    """

    position: Vector
    heading: float


class Wanted(NamedTuple):
    """Setpoint of a simplified vehicle.

    Attributes:
        kind: POSITION, VELOCITY or ACCELERATION.
        vector: position, velocity or acceleration, ENU, m, m/s or m/s^2.
        yaw_rate: yaw rate, rad/s, counter-clockwise.
        yaw: heading, rad from east, counter-clockwise; NaN if ``yaw_rate`` applies.
    """

    kind: int
    vector: Vector
    yaw_rate: float
    yaw: float


def wanted(setpoint: Setpoint, start: Start, heading: float) -> Wanted:
    """Return a MAVROS setpoint in the form of the simplified vehicles.

    LOCAL_NED is ENU. The vectors of BODY_NED and BODY_OFFSET_NED are FLU, rotated by the heading. Position and yaw of
    BODY_OFFSET_NED are relative to the vehicle at the start of the command; BODY_NED supports neither. A yaw takes
    precedence over a yaw rate; without both the heading is kept.


    Args:
        setpoint: frame, mask and values of a mavros_msgs/PositionTarget.
        start: where the vehicle was when the command was received; used in BODY_OFFSET_NED only.
        heading: current heading of the vehicle, rad from east, counter-clockwise.

        Raises:
            SetpointError: unsupported frame; a mask with none or several of position, velocity and acceleration, with
                only some of the components, or with a force; or a value that is not finite.
    """
    frame, mask = setpoint.frame, setpoint.type_mask
    if frame not in _FRAMES:
        known = ", ".join(f"{number} ({name})" for number, name in _FRAMES.items())
        raise SetpointError(f"coordinate_frame {frame} is not supported, {known} are")
    kind, name = _what(mask)
    values: Vector = {POSITION: setpoint.position, VELOCITY: setpoint.velocity}.get(kind, setpoint.acceleration)
    if kind == ACCELERATION and mask & FORCE:
        raise SetpointError(f"type_mask {mask}: a force is not supported")
    if kind == POSITION and frame == FRAME_BODY_NED:
        raise SetpointError("coordinate_frame 8 (BODY_NED) has no position, 9 (BODY_OFFSET_NED) has")
    yaw = math.nan if mask & IGNORE_YAW else setpoint.yaw
    yaw_rate = 0.0 if mask & IGNORE_YAW_RATE or not mask & IGNORE_YAW else setpoint.yaw_rate
    turning = (0.0 if mask & IGNORE_YAW else yaw, yaw_rate)
    bad = first_bad_field((f"{name}.x", f"{name}.y", f"{name}.z", "yaw", "yaw_rate"), (*values, *turning))
    if bad is not None:
        raise SetpointError(f"{bad}: not flown")
    if frame == FRAME_BODY_OFFSET_NED:
        yaw = math.remainder(start.heading + yaw, math.tau)
    if frame == FRAME_BODY_OFFSET_NED and kind == POSITION:
        x, y, z = flu_to_enu(values, start.heading)
        values = start.position[0] + x, start.position[1] + y, start.position[2] + z
    elif frame != FRAME_LOCAL_NED:
        values = flu_to_enu(values, heading)
    return Wanted(kind, values, yaw_rate, yaw)


def flu_to_enu(vector: Vector, heading: float) -> Vector:
    """Return a vector of a level vehicle (forward, left, up) in ENU.

    Args:
        vector: FLU, any unit.
        heading: heading of the vehicle, rad from east, counter-clockwise.
    """
    x, y, z = vector
    cos, sin = math.cos(heading), math.sin(heading)
    return cos * x - sin * y, sin * x + cos * y, z


def _what(mask: int) -> tuple[int, str]:
    """Return the quantity selected by a type mask, and its name."""
    asked = [(kind, name) for ignored, kind, name in _KINDS if not mask & ignored]
    partly = [name for ignored, _, name in _KINDS if 0 < mask & ignored < ignored]
    if partly:
        raise SetpointError(f"type_mask {mask}: only a part of {' and '.join(partly)} is not flown")
    if len(asked) != 1:
        names = " and ".join(name for _, name in asked) or "nothing"
        raise SetpointError(f"type_mask {mask} asks for {names}; one of position, velocity, acceleration is supported")
    return asked[0]
