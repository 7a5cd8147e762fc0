"""Mission files in the text format ``QGC WPL`` of early QGroundControl, Mission Planner, MAVProxy and MAVROS.

After the line ``QGC WPL 110`` (or 120) each line is an item, separated by tabs: index, current (0 or 1), MAV_FRAME,
MAV_CMD, param1 to param4, x (latitude), y (longitude), z (altitude), autocontinue. In version 110 the first item is the
home position, as in ArduPilot; version 120 has no such item. Lines starting with ``#`` are comments.
Source: https://mavlink.io/en/file_formats/#mission_plain_text_file
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import NamedTuple

from xtdrone_autopilot.navigator.plan import PlanItem

WITH_HOME = 110
VERSIONS = (WITH_HOME, 120)
_COLUMNS = 12
_LARGEST_FLOAT = 3.4028234663852886e38  # limit of MAVLink's floats
_NUMBERS = ("param1", "param2", "param3", "param4", "x", "y", "z")


class WaypointFileError(ValueError):
    """An invalid file: the message names the file, the line, the value and the allowed values."""


class Row(NamedTuple):
    """One line.

    Attributes:
        item: plan item; positions in degrees and m.
        current: whether it was the current item of the vehicle.
    """

    item: PlanItem
    current: bool = False


def read(text: str, name: str) -> list[Row]:
    """Return the items of a file.

    Args:
        text: content of the file.
        name: name of the file in error messages.

    Raises:
        WaypointFileError: a line is not in this format.
    """
    rows: list[Row] = []
    begun = False
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        where = f"{name}, line {number}"
        if begun:
            rows.append(_row(line.split(), where))
        else:
            begun = bool(_version(line, where))
    if not begun:
        raise WaypointFileError(f"{name}: is empty, its first line must be QGC WPL 110 or QGC WPL 120")
    return rows


def version(text: str) -> int:
    """Return the version of a file's text that ``read`` accepts, 110 or 120."""
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    return _version(next(lines), "")


def write(rows: Iterable[Row]) -> str:
    """Return the text of a file of version 120 with CRLF line endings, as written by MAVROS."""
    lines = ["QGC WPL 120"]
    for index, (item, current) in enumerate(rows):
        numbers = (repr(float(value)) for value in (*item.params, item.x, item.y, item.z))
        columns = (str(index), str(int(current)), str(item.frame), str(item.command), *numbers)
        lines.append("\t".join((*columns, str(int(item.autocontinue)))))
    return "".join(line + "\r\n" for line in lines)


def _version(line: str, where: str) -> int:
    words = line.split()
    if len(words) == 3 and words[:2] == ["QGC", "WPL"] and words[2] in map(str, VERSIONS):
        return int(words[2])
    raise WaypointFileError(f"{where}: {line.strip()[:40]!r} is not allowed, QGC WPL 110 or QGC WPL 120")


def _row(columns: list[str], where: str) -> Row:
    if len(columns) != _COLUMNS:
        raise WaypointFileError(f"{where}: {len(columns)} columns are not allowed, {_COLUMNS}")
    _whole(columns[0], 0xFFFF, "index", where)
    current = _whole(columns[1], 1, "current", where)
    frame = _whole(columns[2], 0xFF, "frame", where)
    command = _whole(columns[3], 0xFFFF, "command", where)
    a, b, c, d, x, y, z = [_number(text, name, where) for text, name in zip(columns[4:11], _NUMBERS, strict=True)]
    autocontinue = _whole(columns[11], 1, "autocontinue", where)
    return Row(PlanItem(command, frame, (a, b, c, d), x, y, z, bool(autocontinue)), bool(current))


def _whole(text: str, largest: int, name: str, where: str) -> int:
    if not re.fullmatch(r"[0-9]{1,9}", text) or int(text) > largest:
        raise WaypointFileError(f"{where}: {name} {text!r} is not allowed, 0 to {largest}")
    return int(text)


def _number(text: str, name: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.inf
    if abs(value) > _LARGEST_FLOAT:
        raise WaypointFileError(f"{where}: {name} {text!r} is not allowed, a number of 32 bits or nan")
    return value
