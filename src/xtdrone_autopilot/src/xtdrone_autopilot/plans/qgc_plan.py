"""QGroundControl's .plan files: conversion of mission, geofence and rally points of one vehicle to plan items and back.

Format: https://docs.qgroundcontrol.com/master/en/qgc-dev-guide/file_formats/plan.html. Items are read from frame and
parameters; the ``Altitude`` keys, used for display only, are ignored. Patterns are expanded to the items that they
contain or, of a structure scan, describe; the target of DO_JUMP, a ``doJumpId`` in the file, becomes the index of an
item.

What QGroundControl writes and reads itself is read: a home position or altitude that is null because it is unknown,
fences of version 1, items of version 1 with a ``coordinate``, and missions in the text format ``QGC WPL``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

from xtdrone_autopilot.mavlink.microservices import mission_items
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import FRAME_MISSION, Items, PlanItem
from xtdrone_autopilot.plans import waypoint_file
from xtdrone_autopilot.plans.structure_scan import StructureScan, different_corners
from xtdrone_common.files import MB, ContentError, load_json, read_text, write_whole

SUFFIX = ".plan"
SUFFIXES = (SUFFIX, ".waypoints")
"""Of the files that ``read`` reads; the second is Mission Planner's."""
LARGEST = 16 * MB  # several thousand items take a few MB
FRAME_GLOBAL, FRAME_RELATIVE = 0, 3  # MAV_FRAME: altitude above sea level, above home

_MAVLINK_FRAMES = {0: FRAME_GLOBAL, 5: FRAME_GLOBAL, 3: FRAME_RELATIVE, 6: FRAME_RELATIVE, 2: FRAME_MISSION}
_ALTITUDE_MODES = {FRAME_RELATIVE: 1, FRAME_GLOBAL: 2}  # QGroundControl's: relative to launch, AMSL
_GENERIC, _ARDUPILOT, _PX4 = 0, 3, 12  # MAV_AUTOPILOT
_FOREIGN = {_GENERIC: "no autopilot in particular", _ARDUPILOT: "ArduPilot"}
_MULTICOPTER = 2  # MAV_TYPE
_STRUCTURE = "StructureScan"
_PATTERNS = ("survey", "CorridorScan", _STRUCTURE)  # the items of the first two are in the file
_MOST_LAYERS = 1000
_TRANSECTS = "TransectStyleComplexItem"
_LARGEST_COMMAND = 0xFFFF
_LARGEST_NUMBER = 3.4e38  # limit of MAVLink's floats
_LEAST_CORNERS = 3
_FAR_ALTITUDE = 100_000.0  # m, above and below
_POLYGONS = {plan.FENCE_INCLUSION: True, plan.FENCE_EXCLUSION: False}
_CIRCLES = {plan.FENCE_CIRCLE_INCLUSION: True, plan.FENCE_CIRCLE_EXCLUSION: False}

Position = tuple[float, float, float]


class PlanError(ValueError):
    """An invalid plan: the message names the file, the item, the value and the allowed values."""


@dataclass(frozen=True)
class Plan:
    """Content of a .plan file for one vehicle.

    Attributes:
        mission: mission items; param1 of DO_JUMP is the index of its target item.
        fence: FENCE_* items: corners polygon by polygon, circles, a return point.
        rally: RALLY_POINT items.
        home: planned home position: latitude, longitude, degrees, altitude, m AMSL; not used in flight.
        cruise_speed, hover_speed: m/s, used by QGroundControl to estimate times; not sent to the vehicle.
        firmware: MAV_AUTOPILOT that the plan was made for; its items have PX4's meaning in any case.
    """

    mission: Items
    fence: Items = ()
    rally: Items = ()
    home: Position = (0.0, 0.0, 0.0)
    cruise_speed: float = 15.0
    hover_speed: float = 5.0
    firmware: int = _PX4

    @property
    def drawn_for(self) -> str:
        """Name of the autopilot that the plan was made for; empty for PX4."""
        return _FOREIGN.get(self.firmware, "")

    def items(self, kind: int) -> Items:
        """Return the items of a MAV_MISSION_TYPE: 0 mission, 1 fence, 2 rally."""
        return (self.mission, self.fence, self.rally)[kind]


# ---- reading


def read(path: str | Path) -> Plan:
    """Return the plan in a file.

    Raises:
        PlanError: the file cannot be read, is not a plan, or has an invalid value.
    """
    try:
        text = read_text(path, LARGEST)
    except (OSError, ContentError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise PlanError(f"{path}: cannot be read: {reason}") from error
    return parse(text, str(path))


def parse(text: str, name: str = "plan") -> Plan:
    """Return the plan in the text of a .plan file, or of a mission file; ``name`` is its name in error messages.

    Raises:
        PlanError: the text is not a plan, or has an invalid value.
    """
    if text.lstrip().startswith("QGC WPL"):
        return _parse_rows(text, name)
    try:
        content = load_json(text, _no_constant)
    except ValueError as error:
        raise PlanError(f"{name}: is not JSON: {error}") from error
    file = _Value(name, content)
    file.get("fileType").one_of(("Plan",))
    file.get("version").one_of((1,))
    mission = file.get("mission")
    mission.get("version").one_of((2,))
    firmware = mission.get("firmwareType", _PX4).one_of((_PX4, *_FOREIGN))
    return Plan(
        _read_mission(mission),
        _read_fence(file.get("geoFence", {})),
        _read_rally(file.get("rallyPoints", {})),
        _read_home(mission.get("plannedHomePosition", [])),
        mission.get("cruiseSpeed", 15.0).number_or(15.0, 0.0, 1000.0),
        mission.get("hoverSpeed", 5.0).number_or(5.0, 0.0, 1000.0),
        firmware,
    )


def _parse_rows(text: str, name: str) -> Plan:
    """Return the mission of a file in the text format, see ``waypoint_file``.

    In version 110 the first item is the home position and index 0 of jumps, as in ArduPilot and QGroundControl. Mission
    Planner gives items without a position a global frame, which PX4 does not accept: they get the mission frame.
    """
    try:
        rows = waypoint_file.read(text, name)
    except ValueError as error:
        raise PlanError(str(error)) from error
    items = [row.item for row in rows]
    home = (0.0, 0.0, 0.0)
    if items and waypoint_file.version(text) == waypoint_file.WITH_HOME:
        first = items.pop(0)
        home = (first.x, first.y, first.z)
        items = [_moved_jump(item, -1.0) for item in items]
    return Plan(tuple(_accepted(item, f"{name}: item {i}") for i, item in enumerate(items, 1)), home=home)


def _moved_jump(item: PlanItem, offset: float) -> PlanItem:
    """Return an item; the target of a jump is moved by ``offset`` items."""
    return replace(item, params=(item.params[0] + offset, *item.params[1:])) if item.command == plan.JUMP else item


def _accepted(item: PlanItem, where: str) -> PlanItem:
    """Return an item in a frame in which PX4 accepts its command."""
    frame = _MAVLINK_FRAMES.get(item.frame)
    if frame is not None and mission_items.accepts(item.command, frame != FRAME_MISSION):
        return replace(item, frame=frame)
    if frame is not None and mission_items.accepts(item.command, False):
        return replace(item, frame=FRAME_MISSION)
    raise PlanError(f"{where}: command {item.command} in frame {item.frame} is not allowed, one that PX4 accepts there")


def _no_constant(constant: str) -> float:
    raise ValueError(f"{constant} is not a JSON number; write null for an unset parameter")


class _Value:
    """A value of the file with its path, for error messages."""

    def __init__(self, where: str, value: Any) -> None:
        self.where = where
        self.value = value

    def not_allowed(self, allowed: str) -> PlanError:
        """Return the error for this value; ``allowed`` describes the allowed values."""
        shown = json.dumps(self.value)
        return PlanError(f"{self.where}: {shown[:60]}{'...' * (len(shown) > 60)} is not allowed, {allowed}")

    def get(self, key: str, default: Any = None) -> _Value:
        """Return the value of ``key`` in this object, or the default.

        Raises:
            PlanError: this is not an object, or the key is missing and has no default.
        """
        if not isinstance(self.value, dict):
            raise self.not_allowed("an object")
        if key in self.value:
            return _Value(f"{self.where}: {key}", self.value[key])
        if default is None:
            raise PlanError(f"{self.where}: {key} is missing")
        return _Value(f"{self.where}: {key}", default)

    def list(self, name: str, length: int | None = None) -> list[_Value]:
        """Return the elements of this list; their paths are ``name`` and a number from 1.

        Raises:
            PlanError: this is not a list, or not of ``length``.
        """
        if not isinstance(self.value, list) or length not in (None, len(self.value)):
            raise self.not_allowed("a list" if length is None else f"a list of {length}")
        return [_Value(f"{self.where}: {name} {i}", value) for i, value in enumerate(self.value, 1)]

    def one_of(self, allowed: Sequence[Any]) -> Any:
        """Return this value, which must be one of ``allowed``."""
        if isinstance(self.value, bool) or self.value not in allowed:
            raise self.not_allowed(" or ".join(json.dumps(value) for value in allowed))
        return self.value

    def whole(self, low: int, high: int) -> int:
        """Return this value, which must be an integer in ``low``..``high``."""
        number = isinstance(self.value, (int, float)) and not isinstance(self.value, bool)
        if not number or not low <= self.value <= high or self.value != int(self.value):
            raise self.not_allowed(f"a whole number from {low} to {high}")
        return int(self.value)

    def flag(self) -> bool:
        """Return this value, which must be true or false."""
        if not isinstance(self.value, bool):
            raise self.not_allowed("true or false")
        return self.value

    def number(self, low: float, high: float) -> float:
        """Return this value, which must be a number in ``low``..``high``."""
        number = isinstance(self.value, (int, float)) and not isinstance(self.value, bool)
        if not number or not low <= self.value <= high:
            raise self.not_allowed(f"a number from {low:g} to {high:g}")
        return float(self.value)

    def number_or(self, default: float, low: float, high: float) -> float:
        """Return this value, a number in ``low``..``high``, or ``default`` for null."""
        return default if self.value is None else self.number(low, high)

    def parameter(self) -> float:
        """Return this value as a parameter: a number, or NaN for null."""
        return math.nan if self.value is None else self.number(-_LARGEST_NUMBER, _LARGEST_NUMBER)


def _read_mission(mission: _Value) -> Items:
    found = list(chain.from_iterable(_read_item(item) for item in mission.get("items").list("item")))
    index_of: dict[int, int] = {}
    for i, (_, jump_id, _) in enumerate(found):
        if jump_id is not None:
            index_of.setdefault(jump_id, i)
    return tuple(_with_index(where, item, index_of) for where, _, item in found)


def _read_item(entry: _Value) -> list[tuple[_Value, int | None, PlanItem]]:
    """Return the items of an entry, each with its value in the file and its doJumpId."""
    if entry.get("type").one_of(("SimpleItem", "ComplexItem")) == "SimpleItem":
        return [_read_simple(entry)]
    if entry.get("complexItemType").one_of(_PATTERNS) == _STRUCTURE:
        return [(entry, None, item) for item in _read_structure(entry).items()]
    items = entry.get(_TRANSECTS).get("Items")
    return [_read_simple(item) for item in items.list("item")]


def _read_structure(entry: _Value) -> StructureScan:
    corners = entry.get("polygon").list("corner")
    if len(corners) < _LEAST_CORNERS:
        raise entry.get("polygon").not_allowed(f"at least {_LEAST_CORNERS} corners")
    layers, most = entry.get("Layers").whole(0, _MOST_LAYERS), plan.CAPACITY[plan.MISSION]
    if StructureScan.length(layers, len(corners)) > most:
        raise PlanError(
            f"{entry.where}: {layers} layers of {len(corners)} corners are not allowed, at most {most} mission items"
        )
    outline = tuple(_read_position(corner, 2)[:2] for corner in corners)
    if different_corners(outline) < _LEAST_CORNERS:
        raise entry.get("polygon").not_allowed(f"at least {_LEAST_CORNERS} different corners")
    camera = entry.get("CameraCalc")

    def height(name: str) -> float:
        return entry.get(name).number(-_FAR_ALTITUDE, _FAR_ALTITUDE)

    return StructureScan(
        outline=outline,
        distance=camera.get("DistanceToSurface").number(0.0, _FAR_ALTITUDE),
        entrance=height("EntranceAltitude"),
        bottom=height("ScanBottomAlt"),
        top=height("StructureHeight"),
        layers=layers,
        layer_height=camera.get("AdjustedFootprintFrontal").number(0.0, _FAR_ALTITUDE),
        trigger_distance=camera.get("AdjustedFootprintSide").number(0.0, _FAR_ALTITUDE),
        pitch=entry.get("GimbalPitch").number(-180.0, 180.0),
        from_top=entry.get("StartFromTop").flag(),
    )


def _read_simple(entry: _Value) -> tuple[_Value, int | None, PlanItem]:
    entry.get("type").one_of(("SimpleItem",))
    command = entry.get("command").whole(0, _LARGEST_COMMAND)
    frame = _MAVLINK_FRAMES[entry.get("frame").one_of(tuple(sorted(_MAVLINK_FRAMES)))]
    positioned = frame != FRAME_MISSION
    if not mission_items.accepts(command, positioned):
        kind = "with" if positioned else "without"
        raise entry.get("command").not_allowed(f"a MAV_CMD that PX4 accepts {kind} a position (frame {frame})")
    values = _param_values(entry)
    params = [value.parameter() for value in values]
    x, y, z = _params_position(values) if positioned else [0.0 if math.isnan(value) else value for value in params[4:]]
    jump_id = entry.get("doJumpId").whole(0, 1 << 30) if "doJumpId" in entry.value else None
    item = PlanItem(
        command, frame, (params[0], params[1], params[2], params[3]), x, y, z, entry.get("autoContinue", True).flag()
    )
    return entry, jump_id, item


def _param_values(entry: _Value) -> list[_Value]:
    """Return the seven parameters of an item; in version 1 the last three are its coordinate."""
    if "coordinate" not in entry.value or "params" in entry.value:
        return entry.get("params").list("param", 7)
    return [*(entry.get(f"param{i}") for i in range(1, 5)), *entry.get("coordinate").list("number", 3)]


def _params_position(params: list[_Value]) -> Position:
    return (
        params[4].number(-90.0, 90.0),
        params[5].number(-180.0, 180.0),
        params[6].number(-_FAR_ALTITUDE, _FAR_ALTITUDE),
    )


def _with_index(where: _Value, item: PlanItem, index_of: dict[int, int]) -> PlanItem:
    """Return ``item``, a DO_JUMP with the index of its target instead of the doJumpId.

    A target out of the mission, which PX4 accepts, is possible where the ids are the numbers of the items.
    """
    if item.command != plan.JUMP:
        return item
    target = item.params[0]
    whole = abs(target) < 1 << 31 and target == target // 1
    index = index_of.get(int(target)) if whole else None
    if index is None and whole and all(i == at + 1 for i, at in index_of.items()):
        index = int(target) - 1
    if index is None:
        ids = f"{min(index_of)} to {max(index_of)}" if index_of else "none there"
        raise PlanError(f"{where.where}: DO_JUMP to {target:g} is not allowed, the doJumpId of an item ({ids})")
    return replace(item, params=(float(index), *item.params[1:]))


def _read_position(value: _Value, length: int) -> Position:
    """Return [latitude, longitude] or [latitude, longitude, altitude]; a missing or null altitude is 0."""
    numbers = value.list("number", length)
    altitude = numbers[2].number_or(0.0, -_FAR_ALTITUDE, _FAR_ALTITUDE) if length == 3 else 0.0
    return numbers[0].number(-90.0, 90.0), numbers[1].number(-180.0, 180.0), altitude


def _read_home(value: _Value) -> Position:
    """Return the planned home position, zeros for one that is missing or null."""
    if value.value is None or (isinstance(value.value, list) and not any(value.value)):
        return 0.0, 0.0, 0.0
    return _read_position(value, 2 if isinstance(value.value, list) and len(value.value) == 2 else 3)


def _item(command: int, frame: int, param1: float, position: Position) -> PlanItem:
    return PlanItem(command, frame, (param1, 0.0, 0.0, 0.0), *position, autocontinue=False)


def _read_fence(fence: _Value) -> Items:
    if not fence.value:
        return ()
    items: list[PlanItem] = []
    if fence.get("version", 1).one_of((1, 2)) == 1 and fence.get("polygon", []).value:  # version 1: one, inclusive
        polygons = [_Value(fence.where, {"inclusion": True, "polygon": fence.get("polygon").value})]
    else:
        polygons = fence.get("polygons", []).list("polygon")
    for polygon in polygons:
        command = plan.FENCE_INCLUSION if polygon.get("inclusion").flag() else plan.FENCE_EXCLUSION
        corners = polygon.get("polygon").list("corner")
        if len(corners) < _LEAST_CORNERS:
            raise polygon.get("polygon").not_allowed(f"at least {_LEAST_CORNERS} corners")
        items += [_item(command, FRAME_GLOBAL, float(len(corners)), _read_position(corner, 2)) for corner in corners]
    for entry in fence.get("circles", []).list("circle"):
        command = plan.FENCE_CIRCLE_INCLUSION if entry.get("inclusion").flag() else plan.FENCE_CIRCLE_EXCLUSION
        radius = entry.get("circle").get("radius").number(0.0, _FAR_ALTITUDE)
        items.append(_item(command, FRAME_GLOBAL, radius, _read_position(entry.get("circle").get("center"), 2)))
    if fence.value.get("breachReturn"):
        position = _read_position(fence.get("breachReturn"), 3)
        items.append(_item(plan.FENCE_RETURN_POINT, FRAME_RELATIVE, 0.0, position))
    return tuple(items)


def _read_rally(rally: _Value) -> Items:
    if not rally.value:
        return ()
    rally.get("version", 1).one_of((1, 2))
    points = rally.get("points", []).list("point")
    return tuple(_item(plan.RALLY_POINT, FRAME_RELATIVE, 0.0, _read_position(point, 3)) for point in points)


# ---- writing


def write(path: str | Path, content: Plan) -> None:
    """Write a plan to a file.

    Raises:
        PlanError: the plan cannot be represented in this format; nothing is written.
        OSError: the file cannot be written.
    """
    write_whole(path, text_of(content))


def text_of(content: Plan) -> str:
    """Return the text of a .plan file, in the form that QGroundControl writes.

    Raises:
        PlanError: the plan cannot be represented: a non-finite number, corners that do not form a polygon, or an
            altitude above sea level of a rally point without a home position.
    """
    document = {
        "fileType": "Plan",
        "geoFence": _fence_object(content.fence, content.home),
        "groundStation": "QGroundControl",
        "mission": {
            "cruiseSpeed": content.cruise_speed,
            "firmwareType": content.firmware,
            "hoverSpeed": content.hover_speed,
            "items": [_item_object(i, item) for i, item in enumerate(content.mission)],
            "plannedHomePosition": list(content.home),
            "vehicleType": _MULTICOPTER,
            "version": 2,
        },
        "rallyPoints": {"points": [_above_home(point, content.home) for point in content.rally], "version": 2},
        "version": 1,
    }
    try:
        return json.dumps(document, indent=4, allow_nan=False) + "\n"
    except ValueError as error:
        raise PlanError("plan: a number that is not finite is not allowed outside an item's parameters") from error


def _finite_or_null(value: float, where: str) -> float | None:
    if math.isinf(value):
        raise PlanError(f"{where}: {value} is not allowed, a finite number or NaN")
    return None if math.isnan(value) else float(value)


def _position(item: PlanItem) -> Position:
    return float(item.x), float(item.y), float(item.z)


def _above_home(point: PlanItem, home: Position) -> list[float]:
    """Return the position of a rally or return point, whose altitude is above home in this format."""
    x, y, z = _position(point)
    if point.relative:
        return [x, y, z]
    if not any(home):
        raise PlanError(f"plan: an altitude above sea level, {z:g} m, is not allowed without a home position")
    return [x, y, z - home[2]]


def _item_object(index: int, item: PlanItem) -> dict[str, Any]:
    where = f"item {index + 1}"
    if item.frame not in _MAVLINK_FRAMES:
        raise PlanError(f"{where}: frame {item.frame} is not allowed, {sorted(_MAVLINK_FRAMES)}")
    frame = _MAVLINK_FRAMES[item.frame]
    first = item.params[0]
    if item.command == plan.JUMP:
        first += 1.0
    params = [_finite_or_null(value, where) for value in (first, *item.params[1:], *_position(item))]
    found: dict[str, Any] = {}
    if item.has_position and frame in _ALTITUDE_MODES:
        found = {"AMSLAltAboveTerrain": None, "Altitude": params[6], "AltitudeMode": _ALTITUDE_MODES[frame]}
    return found | {
        "autoContinue": item.autocontinue,
        "command": item.command,
        "doJumpId": index + 1,
        "frame": frame,
        "params": params,
        "type": "SimpleItem",
    }


def _fence_object(fence: Items, home: Position) -> dict[str, Any]:
    polygons: list[dict[str, Any]] = []
    circles: list[dict[str, Any]] = []
    found: dict[str, Any] = {"circles": circles, "polygons": polygons, "version": 2}
    i = 0
    while i < len(fence):
        item = fence[i]
        i += 1
        if item.command in _POLYGONS:
            corners = _corners(fence, i - 1)
            i += len(corners) - 1
            path = [[corner.x, corner.y] for corner in corners]
            polygons.append({"inclusion": _POLYGONS[item.command], "polygon": path, "version": 1})
        elif item.command in _CIRCLES:
            circle = {"center": [item.x, item.y], "radius": item.params[0]}
            circles.append({"circle": circle, "inclusion": _CIRCLES[item.command], "version": 1})
        elif item.command == plan.FENCE_RETURN_POINT:
            found["breachReturn"] = _above_home(item, home)
        else:
            raise PlanError(f"fence item {i}: command {item.command} is not allowed, 5000 to 5004")
    return found


def _corners(fence: Items, start: int) -> Items:
    """Return the corners of the polygon that starts at index ``start``."""
    first = fence[start]
    corners = fence[start : start + int(first.params[0])] if math.isfinite(first.params[0]) else ()
    alike = all(c.command == first.command and c.params[0] == first.params[0] for c in corners)
    if len(corners) < _LEAST_CORNERS or len(corners) != first.params[0] or not alike:
        raise PlanError(
            f"fence item {start + 1}: a polygon of {first.params[0]:g} corners is not allowed, "
            f"at least {_LEAST_CORNERS} that follow each other"
        )
    return corners
