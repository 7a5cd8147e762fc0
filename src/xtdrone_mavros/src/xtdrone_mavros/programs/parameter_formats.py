"""Parameter files of mavparam: QGroundControl's, Mission Planner's and MAVProxy's.

QGroundControl's lines have five tab-separated columns (``parameter_file``). The other two have a name and a value,
separated by a comma or blanks. ``#`` begins a comment in all formats. A value with a decimal point is a float, one
without is an integer (MAVROS, ``mavros/src/mavros/param.py``).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping

from xtdrone_autopilot.parameters.parameter_file import REAL32, ParameterFile, checked, parse, text_of, written

QGC, MISSION_PLANNER, MAVPROXY = "qgc", "mp", "mavpx"
_NAME = re.compile(r"[A-Za-z0-9_]{1,16}")
_INTEGER = re.compile(r"[+-]?[0-9]{1,19}")
_INT32 = 6  # MAV_PARAM_TYPE of integers
_SEPARATOR = {MISSION_PLANNER: ",", MAVPROXY: " "}
_END = "\r\n"  # line ending of the two-column formats

Number = int | float


class FormatError(ValueError):
    """An unreadable file: the message gives the file, the line, the value and the allowed values."""


def format_of(name: str) -> str:
    """Return the format in which MAVROS writes a file with this name: QGroundControl's for ``.txt``."""
    return QGC if name.endswith(".txt") else MISSION_PLANNER


def guess(text: str) -> str:
    """Detect the format of a file's text from its first line with a parameter."""
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    first = next(lines, "")
    if "\t" in first:
        return QGC
    return MISSION_PLANNER if "," in first else MAVPROXY


def read(text: str, name: str, kind: str = "", note: Callable[[str], None] = lambda _: None) -> dict[str, Number]:
    """Parse a parameter file.

    Args:
        text: the file's content.
        name: the file's name, for error messages.
        kind: QGC, MISSION_PLANNER or MAVPROXY; empty: detect it from the content.
        note: receives a description of each row of QGroundControl's format that is skipped.

    Returns:
        The values by name, a float for each REAL32.

    Raises:
        FormatError: the content is invalid.
    """
    kind = kind or guess(text)
    if kind != QGC:
        return _read_pairs(text, name, _SEPARATOR[kind])
    try:
        found = parse(text, name)
    except ValueError as error:
        raise FormatError(str(error)) from error
    for skipped in found.skipped:
        note(skipped)
    return {key: float(value) if form == REAL32 else int(value) for key, (value, form) in found.values.items()}


def write(values: Mapping[str, Number], kind: str, system: int = 1) -> str:
    """Return the text of a parameter file.

    Args:
        values: Values by name; floats are written with a decimal point, integers without.
        kind: QGC, MISSION_PLANNER or MAVPROXY.
        system: the vehicle's MAVLink system id, 1 to 255; used only in QGroundControl's files.
    """
    typed = {name: (value, REAL32 if isinstance(value, float) else _INT32) for name, value in values.items()}
    if kind == QGC:
        return text_of(ParameterFile(system, typed))
    rows = [f"{name}{_SEPARATOR[kind]}{written(*typed[name])}" for name in sorted(typed)]
    return "".join(row + _END for row in ["#NOTE: saved by mavparam", *rows])


def number_of(text: str) -> Number:
    """Parse a value given by a user or a file.

    Raises:
        ValueError: MAVLink cannot represent the value; the message gives the allowed values.
    """
    if _INTEGER.fullmatch(text):
        return int(checked(int(text), _INT32))
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    return float(checked(value, REAL32))


def _read_pairs(text: str, name: str, separator: str) -> dict[str, Number]:
    values: dict[str, Number] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        where = f"{name}, line {number}"
        columns = line.split("," if separator == "," else None)
        if len(columns) != 2:
            raise FormatError(f"{where}: {len(columns)} columns are not allowed, a name and a value")
        key, value = (column.strip() for column in columns)
        if not _NAME.fullmatch(key):
            raise FormatError(f"{where}: name {key!r} is not allowed, 1 to 16 letters, digits and _")
        if key in values:
            raise FormatError(f"{where}: duplicate parameter {key}")
        try:
            values[key] = number_of(value)
        except ValueError as error:
            raise FormatError(f"{where}: {key}: {value!r} is not allowed, {error}") from error
    if not values:
        raise FormatError(f"{name}: the file has no parameters")
    return values
