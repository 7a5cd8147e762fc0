"""The robots of a launch: ``ugv:2,car:1``, or a YAML list with names, types and poses."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

from xtdrone_common.files import ContentError, load_yaml
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_common.settings import SettingError, check_range
from xtdrone_worlds.worlds.robots.robot_model import AnyRobot, load_robot

MOST_ROBOTS = 50

_FIELDS = ("name", "type", "pose")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,59}")
_FIRST, _APART, _ROWS = (12.0, 0.0), 5.0, 3  # m, corner of the grid for robots without a pose
_FAR = 1e5  # m
_WITH_HEIGHT = 4  # numbers of a pose


class Robot(NamedTuple):
    """A robot of a launch.

    Attributes:
        name: such as ``ugv_0``.
        model: its type.
        pose: its start pose.
        has_height: whether z is given; otherwise it starts on the terrain.
    """

    name: str
    model: AnyRobot
    pose: Pose
    has_height: bool = False


def parse_robots(text: str) -> tuple[Robot, ...]:
    """Return the robots that a launch names.

    Args:
        text: TYPE:COUNT, comma-separated, or a YAML list of {name: NAME, type: TYPE, pose: [x, y, yaw]} or [x, y,
            z, yaw], m and rad, ENU; empty for none.

    Raises:
        ValueError: the text is malformed, a type is unknown, a value is not allowed, or a name occurs twice.
    """
    if not text.strip():
        return ()
    entries = _read_list(text) if text.lstrip().startswith("[") else _read_counts(text)
    if len(entries) > MOST_ROBOTS:
        raise SettingError("robots", text[:60], f"at most {MOST_ROBOTS} robots")
    models: dict[str, AnyRobot] = {}
    robots: list[Robot] = []
    for number, entry in enumerate(entries):
        name, kind = _name(entry, number), str(entry.get("type", ""))
        if any(robot.name == name for robot in robots):
            raise SettingError("robots", name, "a name that no other robot has")
        if kind not in models:
            models[kind] = load_robot(kind)
        pose = entry.get("pose")
        has_height = isinstance(pose, list) and len(pose) == _WITH_HEIGHT
        robots.append(Robot(name, models[kind], _pose(name, pose, number), has_height))
    return tuple(robots)


def _read_counts(text: str) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = []
    counts: dict[str, int] = {}
    for part in text.split(","):
        kind, colon, count = part.strip().partition(":")
        if not kind or not (count or "1").isdigit() or (colon and not count) or len(count) > 3:
            raise SettingError("robots", text[:60], "TYPE:COUNT, comma-separated, as ugv:2,car:1, or a YAML list")
        for _ in range(int(count or "1")):
            entries.append({"name": f"{kind}_{counts.get(kind, 0)}", "type": kind})
            counts[kind] = counts.get(kind, 0) + 1
    return entries


def _read_list(text: str) -> list[dict[str, Any]]:
    try:
        entries = load_yaml(text)
    except ContentError as error:
        raise SettingError("robots", text[:60], f"a YAML list: {error}") from error
    if not isinstance(entries, list):
        raise SettingError("robots", text[:60], f"a list of mappings with {', '.join(_FIELDS)}")
    for entry in entries:
        if not isinstance(entry, dict) or not set(entry) <= set(_FIELDS):
            raise SettingError("robots", str(entry)[:60], f"a mapping with {', '.join(_FIELDS)}")
    return entries


def _name(entry: dict[str, Any], number: int) -> str:
    name = entry.get("name")
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise SettingError(f"robots[{number}] name", name, "a letter, and then letters, digits and _, such as ugv_0")
    return name


def _pose(name: str, value: Any, number: int) -> Pose:
    if value is None:
        column, row = divmod(number, _ROWS)
        return Pose((_FIRST[0] + _APART * column, _FIRST[1] + _APART * row, 0.0))
    if not isinstance(value, list) or len(value) not in (2, 3, _WITH_HEIGHT):
        raise SettingError(f"robots: {name}: pose", value, "x, y, m, and optionally yaw, rad, or x, y, z, yaw")
    x, y, *rest = (check_range(f"robots: {name}: pose", part, -_FAR, _FAR) for part in value)
    z, yaw = rest if len(value) == _WITH_HEIGHT else (0.0, rest[0] if rest else 0.0)
    return Pose((x, y, z), from_euler(0.0, 0.0, yaw))
