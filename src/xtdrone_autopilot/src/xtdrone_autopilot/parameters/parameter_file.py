"""QGroundControl's ``.params`` files: the parameters of one vehicle.

A line is ``vehicle-id <tab> component-id <tab> name <tab> value <tab> MAV_PARAM_TYPE``; ``#`` begins a comment, and the
first comments name the autopilot and the kind of vehicle.

As in QGroundControl, a row with an error does not keep the others from being used: a ground station gets it named in
``ParameterFile.skipped`` (``read``), and the simulated autopilot, which reads its own file at boot, logs a warning
(``read_rows``). QGroundControl's files may also have parameters of other components, such as a gimbal.
"""

from __future__ import annotations

import logging
import math
import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from xtdrone_common.files import ContentError, read_text, write_whole

SUFFIX = ".params"
REAL32 = 9
LIMITS = {
    1: (0, 0xFF),
    2: (-0x80, 0x7F),
    3: (0, 0xFFFF),
    4: (-0x8000, 0x7FFF),
    5: (0, 0xFFFFFFFF),
    6: (-0x80000000, 0x7FFFFFFF),
}
"""Smallest and largest value of each integer MAV_PARAM_TYPE."""

_COLUMNS = 5
_NAME = re.compile(r"[A-Za-z0-9_]{1,16}")
_STACK = re.compile(r"#\s*Stack:\s*(\S.*?)\s*")
_LARGEST_SYSTEM = 255  # of components as well
_MOST_DIGITS = 9  # of an id, leading zeros included
_AUTOPILOT = 1  # MAV_COMP_ID
_log = logging.getLogger(__name__)

Value = tuple[float, int]
"""Value of a parameter (an integer unless its type is REAL32) and its MAV_PARAM_TYPE."""
Row = tuple[str, int | float, int]
"""Name, value and MAV_PARAM_TYPE of a parameter."""


class ParameterFileError(ValueError):
    """An invalid parameter file; the message names the file, the line, the value and what is allowed."""


@dataclass(frozen=True)
class ParameterFile:
    """The parameters of one vehicle.

    Attributes:
        system: its MAVLink system id.
        values: Values of the parameters by name.
        stack: autopilot, "PX4 Pro" or "ArduPilot"; empty if the file does not name one.
        skipped: descriptions of the rows that are not among the values, with the name of the file and the line.
    """

    system: int
    values: dict[str, Value] = field(default_factory=dict)
    stack: str = ""
    skipped: tuple[str, ...] = ()


def as_float32(value: float) -> float:
    """Round to the nearest 32-bit float, the type of values in MAVLink.

    Raises:
        OverflowError: the value is out of range.
    """
    found: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return found


def checked(value: float, kind: int) -> float:
    """Convert a value to a parameter type.

    Args:
        value: any number.
        kind: MAV_PARAM_TYPE.

    Raises:
        ValueError: the type cannot represent it; the message is the allowed range.
    """
    if kind == REAL32:
        try:
            if math.isfinite(value):
                return as_float32(value)
        except OverflowError:
            pass
        raise ValueError("a finite number of 32 bits")
    if kind not in LIMITS:
        raise ValueError(f"a type of {', '.join(map(str, LIMITS))} or {REAL32}")
    low, high = LIMITS[kind]
    if not low <= value <= high or value != int(value):
        raise ValueError(f"a whole number from {low} to {high}")
    return int(value)


def read(path: Path) -> ParameterFile:
    """Read a file.

    Raises:
        ParameterFileError: it cannot be read, has parameters of several vehicles, or none that is valid.
    """
    try:
        text = read_text(path)
    except (OSError, ContentError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ParameterFileError(f"{path}: cannot be read: {reason}") from error
    return parse(text, str(path))


def parse(text: str, name: str = "parameters") -> ParameterFile:
    """Parse the text of a file.

    Args:
        text: content of the file.
        name: name of the file in error messages.

    Raises:
        ParameterFileError: it has parameters of several vehicles, or none that is valid.
    """
    stack = ""
    skipped: list[str] = []
    systems: set[int] = set()
    by_component: dict[int, dict[str, Value]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        where = f"{name}, line {number}"
        if line.startswith("#"):
            match = _STACK.fullmatch(line)
            stack = match[1] if match else stack
        elif line.strip():
            try:
                system, component, parameter, value = _row(line, where)
            except ParameterFileError as error:
                skipped.append(str(error))
                continue
            systems.add(system)
            values = by_component.setdefault(component, {})
            if parameter in values:
                skipped.append(f"{where}: {parameter} occurs a second time, this value counts")
            values[parameter] = value
    if len(systems) > 1:
        raise ParameterFileError(f"{name}: parameters of several vehicles: {', '.join(map(str, sorted(systems)))}")
    if not systems:
        more = f"; {skipped[0]}" if skipped else ""
        raise ParameterFileError(f"{name}: the file has no parameters{more}")
    chosen = _AUTOPILOT if _AUTOPILOT in by_component else min(by_component)
    for component in sorted(by_component.keys() - {chosen}):
        skipped.append(f"{name}: {len(by_component[component])} parameters of component {component}, not the autopilot")
    return ParameterFile(systems.pop(), by_component[chosen], stack, tuple(skipped))


def read_rows(path: Path) -> list[Row]:
    """Read the rows of a file that may be missing, skipping invalid rows with a warning; values are not checked."""
    try:
        text = read_text(path)
    except FileNotFoundError:
        return []
    except (OSError, ContentError) as error:
        _log.warning("parameter file %s cannot be read, the defaults are used: %s", path, error)
        return []
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            rows.append(_unchecked_row(line))
        except ValueError as error:
            _log.warning("parameter file %s, line %d is skipped: %s", path, number, error)
    return rows


def _unchecked_row(line: str) -> Row:
    columns = line.split("\t")
    if len(columns) != _COLUMNS:
        raise ValueError(f"{len(columns)} columns, {_COLUMNS} are needed")
    _, _, name, value, kind = columns
    return name, float(value), int(kind)


def _is_id(text: str) -> bool:
    return text.isdecimal() and len(text) <= _MOST_DIGITS and int(text) <= _LARGEST_SYSTEM


def _row(line: str, where: str) -> tuple[int, int, str, Value]:
    columns = [column.strip() for column in line.split("\t")]
    if len(columns) != _COLUMNS:
        raise ParameterFileError(f"{where}: {len(columns)} columns are not allowed, {_COLUMNS} with tabs between")
    system, component, parameter, value, kind = columns
    if not _is_id(system) or int(system) == 0:
        raise ParameterFileError(f"{where}: vehicle id {system[:40]!r} is not allowed, 1 to {_LARGEST_SYSTEM}")
    if not _is_id(component):
        raise ParameterFileError(f"{where}: component id {component[:40]!r} is not allowed, 0 to {_LARGEST_SYSTEM}")
    if not _NAME.fullmatch(parameter):
        raise ParameterFileError(f"{where}: name {parameter!r} is not allowed, 1 to 16 letters, digits and _")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    try:
        checked_value = checked(number, int(kind) if kind.isdecimal() else 0)
        return int(system), int(component), parameter, (checked_value, int(kind))
    except ValueError as error:
        raise ParameterFileError(f"{where}: {parameter}: {value!r} of type {kind!r} is not allowed, {error}") from error


def text_of(content: ParameterFile) -> str:
    """Format a file as QGroundControl writes it."""
    lines = [f"# Onboard parameters for Vehicle {content.system}", "#"]
    lines += [f"# Stack: {content.stack}", "#"] if content.stack else []
    lines += ["# Vehicle-Id Component-Id Name Value Type"]
    for name in sorted(content.values):
        value, kind = content.values[name]
        lines.append(f"{content.system}\t1\t{name}\t{written(value, kind)}\t{kind}")
    return "\n".join(lines) + "\n"


def shown(value: float, kind: int) -> str:
    """Format a value with as many digits as its type distinguishes."""
    if kind != REAL32:
        return str(int(value))
    return str(np.float32(value)).removesuffix(".0")


def written(value: float, kind: int) -> str:
    """Format a value for a file: a REAL32 always with a decimal point, by which MAVROS's mavparam recognises it."""
    return np.format_float_positional(np.float32(value), trim="0") if kind == REAL32 else str(int(value))


def write(path: Path, content: ParameterFile) -> None:
    """Replace a file atomically.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, text_of(content))


def write_changed(path: Path, rows: Iterable[Row], system: int, component: int) -> None:
    """Replace a file atomically with the parameters of an autopilot that differ from its defaults.

    Args:
        path: Path of the file.
        rows: the parameters; values are written with all their digits.
        system, component: MAVLink ids.

    Raises:
        OSError: it cannot be written.
    """
    lines = [
        f"# Parameters of vehicle {system} that differ from its defaults\n",
        "# Vehicle-Id Component-Id Name Value Type\n",
    ]
    lines += [f"{system}\t{component}\t{name}\t{value!r}\t{kind}\n" for name, value, kind in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, "".join(lines))
