"""Plans of a vehicle: mission, geofence and rally points (https://mavlink.io/en/services/mission.html).

Items are stored as received by MAVLink, without validation of their content: like PX4, the navigator stores every item
that it can parse and checks a mission for feasibility before flight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from xtdrone_autopilot import c_casts
from xtdrone_autopilot.tables.reader import Converter, one_of, read_table

# MAV_MISSION_TYPE
MISSION, FENCE, RALLY = 0, 1, 2
KINDS = (MISSION, FENCE, RALLY)
ALL_KINDS = 255

# capacity of PX4 v1.14's simulator build, items by kind
CAPACITY = (0xFFFF - 1, 63, 31)

# MAV_CMD of mission items
WAYPOINT, LOITER_UNLIM, LOITER_TIME, RETURN, LAND, TAKEOFF, LOITER_TO_ALT = 16, 17, 19, 20, 21, 22, 31
ROI, VTOL_TAKEOFF, VTOL_LAND, DELAY = 80, 84, 85, 93
CONDITION_DELAY, CONDITION_DISTANCE, CONDITION_GATE = 112, 114, 4501
JUMP, CHANGE_SPEED, SET_HOME, SET_ACTUATOR, LAND_START = 177, 178, 179, 187, 189
SET_ROI_LOCATION, SET_ROI_NEXT, SET_ROI_NONE, SET_ROI = 195, 196, 197, 201
CONTROL_VIDEO, DIGICAM_CONTROL, MOUNT_CONFIGURE, MOUNT_CONTROL = 200, 203, 204, 205
TRIGGER_DISTANCE, GRIPPER, TRIGGER_INTERVAL, OBLIQUE_SURVEY = 206, 211, 214, 260
CAMERA_MODE, CAMERA_ZOOM, CAMERA_FOCUS = 530, 531, 532
GIMBAL_PITCHYAW, GIMBAL_CONFIGURE = 1000, 1001
START_IMAGES, STOP_IMAGES, TRIGGER_CONTROL = 2000, 2001, 2003
START_VIDEO, STOP_VIDEO, VTOL_TRANSITION, WINCH = 2500, 2501, 3000, 42600
FENCE_RETURN_POINT, FENCE_INCLUSION, FENCE_EXCLUSION = 5000, 5001, 5002
FENCE_CIRCLE_INCLUSION, FENCE_CIRCLE_EXCLUSION, RALLY_POINT = 5003, 5004, 5100

_COMMAND_COLUMNS: dict[str, Converter] = {
    "command": int,
    "name": str,
    "with_position": str,
    "without_position": one_of("yes", "no"),
    "flown": one_of("yes", "no"),
}
_COMMANDS = read_table("mission_commands", _COMMAND_COLUMNS)
POSITIONED: dict[int, str] = {row[0]: row[2] for row in _COMMANDS if row[2]}
"""Commands that may have a position, and how PX4 returns their parameters 1 to 4.

v: unchanged, f: as 0 or 1, y: as a heading, -: as 0.
"""
UNPOSITIONED = frozenset(row[0] for row in _COMMANDS if row[3] == "yes")
"""Commands that may have none."""
FLOWN = frozenset(row[0] for row in _COMMANDS if row[4] == "yes")
"""Commands that PX4's feasibility check allows in a multicopter's mission."""

POSITION_COMMANDS = frozenset(
    (WAYPOINT, LOITER_UNLIM, LOITER_TIME, LAND, TAKEOFF, LOITER_TO_ALT, VTOL_TAKEOFF, VTOL_LAND)
)
_RELATIVE_FRAMES = (3, 6)  # MAV_FRAME_GLOBAL_RELATIVE_ALT(_INT)
FRAME_MISSION = 2
_YAW_COMMANDS = frozenset((WAYPOINT, LOITER_UNLIM, LOITER_TIME, LAND, TAKEOFF, VTOL_TAKEOFF, VTOL_LAND))


def jump(params: Sequence[float]) -> tuple[int, int]:
    """Return index and repeat count of a DO_JUMP as PX4 stores them: -1 repeats, for example, become 65535.

    Source: PX4 ``MavlinkMissionManager::parse_mavlink_mission_item`` into int16 and uint16.
    """
    return c_casts.to_int16(params[0]), c_casts.to_uint16(params[1])


@dataclass(frozen=True, slots=True)
class PlanItem:
    """Item of a mission, a geofence or the rally points.

    Attributes:
        command: MAV_CMD.
        frame: MAV_FRAME as received: 0, 3, 5, 6, or 2 for an item without a position.
        params: param1..param4, NaN where unused.
        x: latitude, degrees; param5 in frame 2.
        y: longitude, degrees; param6 in frame 2.
        z: altitude, m AMSL or above home, see ``relative``; param7 in frame 2.
        autocontinue: continue with the next item after this one.
    """

    command: int
    frame: int
    params: tuple[float, float, float, float]
    x: float
    y: float
    z: float
    autocontinue: bool = True

    @property
    def has_position(self) -> bool:
        """Whether the vehicle flies to the item's position."""
        return self.command in POSITION_COMMANDS

    @property
    def relative(self) -> bool:
        """Whether the altitude is relative to home."""
        return self.frame in _RELATIVE_FRAMES

    def altitude(self, home: float) -> float:
        """Return the altitude, m AMSL, for a home altitude of ``home``, m AMSL."""
        return self.z + home if self.relative else self.z

    @property
    def yaw(self) -> float:
        """Heading at the item, rad from north; NaN for none. PX4 v1.14 turns to the north at LOITER_TO_ALT."""
        if self.command == LOITER_TO_ALT:
            return 0.0
        return math.radians(self.params[3]) if self.command in _YAW_COMMANDS else math.nan

    @property
    def forces_heading(self) -> bool:
        """Whether the item's heading must be reached, even with a heading timeout."""
        flag = {LOITER_TIME: self.params[1], LOITER_TO_ALT: self.params[0]}.get(self.command, 0.0)
        return flag > 0.0

    @property
    def time_inside(self) -> float:
        """Time to stay at the item, s."""
        if self.command not in (WAYPOINT, LOITER_TIME, DELAY) or math.isnan(self.params[0]):
            return 0.0
        return max(self.params[0], 0.0)


Items = tuple[PlanItem, ...]


@dataclass
class Plans:
    """Mission, geofence and rally points of one vehicle; they survive a reboot of its autopilot.

    Attributes:
        items: one list per kind, for example ``items[MISSION]``.
        changes: number of changes per kind.
        current: index of the active or next mission item.
    """

    items: list[Items] = field(default_factory=lambda: [(), (), ()])
    changes: list[int] = field(default_factory=lambda: [0, 0, 0])
    current: int = 0

    @property
    def mission(self) -> Items:
        """Items of the mission."""
        return self.items[MISSION]

    def replace(self, kind: int, items: Sequence[PlanItem]) -> None:
        """Replace the list ``kind`` by ``items``.

        Raises:
            ValueError: more items than ``CAPACITY`` allows.
        """
        if len(items) > CAPACITY[kind]:
            raise ValueError(f"plan {kind}: {len(items)} items are not allowed, at most {CAPACITY[kind]}")
        self.items[kind] = tuple(items)
        self.changes[kind] += 1
