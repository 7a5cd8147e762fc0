"""Conversion of MISSION_ITEM and MISSION_ITEM_INT to plan items and back, with the rules of PX4 v1.14.

PX4 stores only the parameters that an item's command uses, some of them as integers: a download returns the others as
0, headings as 0..360 degrees, and the frame of the requested message type (``MavlinkMissionManager``). What it stores
flies the same after a download and an upload, with two exceptions that are PX4's: LOITER_TIME returns its heading as a
flag of 0 or 1, and DO_SET_ROI of a location returns as one without.
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot import c_casts
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import FRAME_MISSION, PlanItem
from xtdrone_autopilot.parameters.parameter_file import as_float32

_GLOBAL, _RELATIVE, _GLOBAL_INT, _RELATIVE_INT = 0, 3, 5, 6  # MAV_FRAME
_SCALE = 1e7
_INT32_MAX = (1 << 31) - 1

_ROI_NONE, _ROI_NEXT, _ROI_INDEX, _ROI_LOCATION = 0, 1, 2, 3
_ROI_MODES = {
    True: (_ROI_LOCATION, _ROI_NONE),
    False: (_ROI_NONE, _ROI_NEXT, _ROI_INDEX),
}  # by whether it has a position


Params = tuple[float, float, float, float]


class ItemError(ValueError):
    """A rejected item.

    Attributes:
        result: MAV_MISSION_RESULT.
    """

    def __init__(self, result: int, text: str) -> None:
        """Store the result and the error text."""
        super().__init__(text)
        self.result = result


def accepts(command: int, positioned: bool) -> bool:
    """Return whether PX4 accepts ``command`` in a global frame (``positioned``), or else in the mission frame."""
    return command in (plan.POSITIONED if positioned else plan.UNPOSITIONED)


def parse(message: Any, integers: bool) -> PlanItem:
    """Return the item of a MISSION_ITEM, or MISSION_ITEM_INT (``integers``).

    Raises:
        ItemError: a frame, a command or a kind of region of interest that PX4 does not accept.
    """
    frames = (_GLOBAL, _RELATIVE, _GLOBAL_INT, _RELATIVE_INT) if integers else (_GLOBAL, _RELATIVE)
    positioned = message.frame in frames
    if not positioned and message.frame != FRAME_MISSION:
        raise ItemError(mavlink.MAV_MISSION_UNSUPPORTED_FRAME, f"frame {message.frame} is not allowed")
    command = message.command
    if not accepts(command, positioned):
        raise ItemError(mavlink.MAV_MISSION_UNSUPPORTED, f"command {command} is not allowed in frame {message.frame}")
    if command in (plan.ROI, plan.SET_ROI):
        command = plan.SET_ROI
        if not math.isfinite(message.param1) or int(message.param1) not in _ROI_MODES[positioned]:
            raise ItemError(mavlink.MAV_MISSION_INVALID_PARAM1, f"region of interest {message.param1} is not allowed")
    params = _convert(command, (message.param1, message.param2, message.param3, message.param4))
    x, y = message.x, message.y
    if integers:
        x, y = (x / _SCALE, y / _SCALE) if positioned else (as_float32(x), as_float32(y))
    return PlanItem(command, message.frame, params, float(x), float(y), message.z, bool(message.autocontinue))


def _convert(command: int, params: Params) -> Params:
    """Return the parameters of an item with those that PX4 stores as integers converted."""
    a, b, c, d = params
    if command == plan.JUMP:
        index, repeats = plan.jump(params)
        return float(index), float(repeats), c, d
    if command == plan.LAND:
        return a, float(c_casts.to_uint16(b)), c, d
    if command in (plan.FENCE_INCLUSION, plan.FENCE_EXCLUSION):
        return float(c_casts.to_uint16(a + 0.5)), b, c, d
    return params


def _return_as(value: float, how: str) -> float:
    if how == "y":
        return value % 360.0 if math.isfinite(value) else math.nan
    if how == "f":
        return 1.0 if value > 0.0 else 0.0
    return value if how == "v" else 0.0


def _integer(value: float) -> int:
    return round(min(max(value, -_INT32_MAX), _INT32_MAX)) if math.isfinite(value) else 0


def write(item: PlanItem, seq: int, current: bool, kind: int, integers: bool, target: tuple[int, int]) -> Any:
    """Return ``item`` as MISSION_ITEM_INT (``integers``) or MISSION_ITEM.

    Args:
        item: item of the plan.
        seq: its index.
        current: whether it is the item being flown.
        kind: MAV_MISSION_TYPE.
        integers: whether to return MISSION_ITEM_INT.
        target: MAVLink system and component id of the client.
    """
    frame, params, x, y = item.frame, item.params, item.x, item.y
    if frame != FRAME_MISSION:
        frame = (_RELATIVE_INT if integers else _RELATIVE) if item.relative else (_GLOBAL_INT if integers else _GLOBAL)
        a, b, c, d = (_return_as(p, how) for p, how in zip(params, plan.POSITIONED[item.command], strict=True))
        params = a, b, c, d
        if integers:
            x, y = x * _SCALE, y * _SCALE
    coordinates = (_integer(x), _integer(y)) if integers else (x, y)
    make = mavlink.MAVLink_mission_item_int_message if integers else mavlink.MAVLink_mission_item_message
    return make(
        *target, seq, frame, item.command, int(current), int(item.autocontinue), *params, *coordinates, item.z, kind
    )
