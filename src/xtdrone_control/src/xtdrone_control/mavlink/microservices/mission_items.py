"""MISSION_ITEM and MISSION_ITEM_INT to plan items and back, with what PX4 v1.14 takes, refuses and forgets.

PX4 keeps of an item what its command uses: a download shows the rest as 0, headings as 0..360 degrees and the frame
that belongs to the message asked for (``MavlinkMissionManager``).
"""

from __future__ import annotations

import math
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.navigator import plan
from xtdrone_control.autopilot.navigator.plan import FRAME_MISSION, PlanItem

_GLOBAL, _RELATIVE, _GLOBAL_INT, _RELATIVE_INT = 0, 3, 5, 6  # MAV_FRAME
_SCALE = 1e7
_INT32_MAX = (1 << 31) - 1

# commands with a place, and how PX4 tells their parameters again: v as it came, f as 0 or 1, y as a heading, - as 0
_PLACED = {
    plan.WAYPOINT: "vv-y",
    plan.LOITER_UNLIM: "--vy",
    plan.LOITER_TIME: "vfvf",
    plan.LAND: "-v-y",
    plan.TAKEOFF: "---y",
    plan.LOITER_TO_ALT: "fv-f",
    plan.ROI: "----",
    plan.SET_ROI: "----",
    plan.SET_ROI_LOCATION: "----",
    plan.VTOL_TAKEOFF: "---y",
    plan.VTOL_LAND: "---y",
    plan.CONDITION_GATE: "----",
    plan.FENCE_RETURN_POINT: "----",
    plan.FENCE_INCLUSION: "v---",
    plan.FENCE_EXCLUSION: "v---",
    plan.FENCE_CIRCLE_INCLUSION: "v---",
    plan.FENCE_CIRCLE_EXCLUSION: "v---",
    plan.RALLY_POINT: "----",
}
_UNPLACED = frozenset(
    (
        plan.JUMP,
        plan.ROI,
        plan.SET_ROI,
        plan.WINCH,
        plan.GRIPPER,
        plan.CHANGE_SPEED,
        plan.SET_HOME,
        plan.LAND_START,
        plan.TRIGGER_CONTROL,
        plan.DIGICAM_CONTROL,
        plan.MOUNT_CONFIGURE,
        plan.MOUNT_CONTROL,
        plan.GIMBAL_PITCHYAW,
        plan.CAMERA_FOCUS,
        plan.CAMERA_ZOOM,
        plan.GIMBAL_CONFIGURE,
        plan.START_IMAGES,
        plan.STOP_IMAGES,
        plan.START_VIDEO,
        plan.STOP_VIDEO,
        plan.CONTROL_VIDEO,
        plan.TRIGGER_DISTANCE,
        plan.OBLIQUE_SURVEY,
        plan.TRIGGER_INTERVAL,
        plan.CAMERA_MODE,
        plan.VTOL_TRANSITION,
        plan.DELAY,
        plan.RETURN,
        plan.SET_ROI_NEXT,
        plan.SET_ROI_NONE,
        plan.CONDITION_DELAY,
        plan.CONDITION_DISTANCE,
        plan.SET_ACTUATOR,
    )
)
_ROI_NONE, _ROI_NEXT, _ROI_INDEX, _ROI_LOCATION = 0, 1, 2, 3
_ROI_MODES = {True: (_ROI_LOCATION, _ROI_NONE), False: (_ROI_NONE, _ROI_NEXT, _ROI_INDEX)}  # by whether it has a place


class ItemError(ValueError):
    """An item that is refused.

    Attributes:
        result: MAV_MISSION_RESULT.
    """

    def __init__(self, result: int, text: str) -> None:
        """Take the result and what is wrong."""
        super().__init__(text)
        self.result = result


def takes(command: int, placed: bool) -> bool:
    """Return whether PX4 takes items of ``command``, in a global frame (``placed``) or in that of the mission."""
    return command in (_PLACED if placed else _UNPLACED)


def parse(message: Any, integers: bool) -> PlanItem:
    """Return the item of a MISSION_ITEM, or MISSION_ITEM_INT (``integers``).

    Raises:
        ItemError: a frame, a command or a kind of region of interest that PX4 does not take.
    """
    frames = (_GLOBAL, _RELATIVE, _GLOBAL_INT, _RELATIVE_INT) if integers else (_GLOBAL, _RELATIVE)
    placed = message.frame in frames
    if not placed and message.frame != FRAME_MISSION:
        raise ItemError(mavlink.MAV_MISSION_UNSUPPORTED_FRAME, f"frame {message.frame} is not allowed")
    command = message.command
    if not takes(command, placed):
        raise ItemError(mavlink.MAV_MISSION_UNSUPPORTED, f"command {command} is not allowed in frame {message.frame}")
    if command in (plan.ROI, plan.SET_ROI):
        command = plan.SET_ROI
        if not math.isfinite(message.param1) or int(message.param1) not in _ROI_MODES[placed]:
            raise ItemError(mavlink.MAV_MISSION_INVALID_PARAM1, f"region of interest {message.param1} is not allowed")
    params = (message.param1, message.param2, message.param3, message.param4)
    x, y = message.x, message.y
    if placed and integers:
        x, y = x / _SCALE, y / _SCALE
    return PlanItem(command, message.frame, params, float(x), float(y), message.z, bool(message.autocontinue))


def _told(value: float, how: str) -> float:
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
        item: what to tell.
        seq: its index.
        current: whether it is the one that is flown.
        kind: MAV_MISSION_TYPE.
        integers: which of the messages.
        target: MAVLink system and component id that asked.
    """
    frame, params, x, y = item.frame, item.params, item.x, item.y
    if frame != FRAME_MISSION:
        frame = (_RELATIVE_INT if integers else _RELATIVE) if item.relative else (_GLOBAL_INT if integers else _GLOBAL)
        a, b, c, d = (_told(p, how) for p, how in zip(params, _PLACED[item.command], strict=True))
        params = a, b, c, d
        if integers:
            x, y = x * _SCALE, y * _SCALE
    place = (_integer(x), _integer(y)) if integers else (x, y)
    make = mavlink.MAVLink_mission_item_int_message if integers else mavlink.MAVLink_mission_item_message
    return make(*target, seq, frame, item.command, int(current), int(item.autocontinue), *params, *place, item.z, kind)
