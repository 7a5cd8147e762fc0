"""SET_POSITION_TARGET_LOCAL_NED from ENU and FLU, shared by the set-point plugins."""

from __future__ import annotations

from math import isfinite
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control import frames
from xtdrone_control.mavros.uas import Uas

# Frames whose vectors ROS gives in FLU and MAVLink takes in FRD; all others are ENU and NED.
BODY_FRAMES = frozenset({mavlink.MAV_FRAME_BODY_NED, mavlink.MAV_FRAME_BODY_OFFSET_NED})

# type_mask of MAVROS's set-point plugins: what is ignored
ONLY_POSITION_YAW = 1 << 11 | 7 << 6 | 7 << 3
ONLY_VELOCITY_YAW_RATE = 1 << 10 | 7 << 6 | 7 << 0

_ZERO = (0.0, 0.0, 0.0)


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
    """Return the MAVLink set-point, converted as MAVROS does.

    Args:
        uas: whose autopilot it is for.
        time_boot_ms: as in the message, 32 bit.
        frame: MAV_FRAME; in BODY_NED and BODY_OFFSET_NED vectors are FLU and the yaw is relative (its sign turns), in
            others they are ENU and the yaw is measured from east.
        type_mask: POSITION_TARGET_TYPEMASK.
        position: m.
        velocity: m/s.
        acceleration: m/s^2.
        yaw: rad, anticlockwise.
        yaw_rate: rad/s, anticlockwise.
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
