"""QGroundControl's ``.params`` files: all parameters of one vehicle, strictly read.

A line is ``vehicle-id <tab> component-id <tab> name <tab> value <tab> MAV_PARAM_TYPE``; ``#`` begins a comment, and the
first comments say of which autopilot and kind of vehicle they are.
"""

from __future__ import annotations

import math
import os
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from xtdrone_control.bounded_file import ContentError, read_text

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
"""Whole numbers that a MAV_PARAM_TYPE takes: the least and the largest."""

_COLUMNS = 5
_NAME = re.compile(r"[A-Za-z0-9_]{1,16}")
_STACK = re.compile(r"#\s*Stack:\s*(\S.*?)\s*")
_LARGEST_SYSTEM = 255

Value = tuple[float, int]
"""A parameter's value, a whole number unless the type is REAL32, and its MAV_PARAM_TYPE."""


class ParameterFileError(ValueError):
    """A file that is no parameter file: the message names the file, the line, the value and what is allowed."""


@dataclass(frozen=True)
class ParameterFile:
    """The parameters of one vehicle.

    Attributes:
        system: its MAVLink system id.
        values: by name.
        stack: of which autopilot they are, as "PX4 Pro" or "ArduPilot"; empty when the file does not say.
    """

    system: int
    values: dict[str, Value] = field(default_factory=dict)
    stack: str = ""


def as_float32(value: float) -> float:
    """Return the nearest number that MAVLink's floats hold.

    Raises:
        OverflowError: it is too large for them.
    """
    found: float = struct.unpack("<f", struct.pack("<f", value))[0]
    return found


def checked(value: float, kind: int) -> float:
    """Return a value as its type holds it.

    Args:
        value: the number.
        kind: MAV_PARAM_TYPE.

    Raises:
        ValueError: the type does not hold it; says what is allowed.
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
    """Return what a file holds.

    Raises:
        ParameterFileError: it cannot be read, or is no parameter file of one vehicle.
    """
    try:
        text = read_text(path)
    except (OSError, ContentError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise ParameterFileError(f"{path}: cannot be read: {reason}") from error
    return parse(text, str(path))


def parse(text: str, name: str = "parameters") -> ParameterFile:
    """Return what a file's text holds; ``name`` is what messages call it.

    Raises:
        ParameterFileError: it is no parameter file of one vehicle.
    """
    stack = ""
    systems: set[int] = set()
    values: dict[str, Value] = {}
    for number, line in enumerate(text.splitlines(), 1):
        where = f"{name}, line {number}"
        if line.startswith("#"):
            match = _STACK.fullmatch(line)
            stack = match[1] if match else stack
        elif line.strip():
            system, parameter, value = _row(line, where)
            if parameter in values:
                raise ParameterFileError(f"{where}: {parameter} stands there a second time")
            systems.add(system)
            values[parameter] = value
    if len(systems) > 1:
        raise ParameterFileError(f"{name}: parameters of several vehicles: {', '.join(map(str, sorted(systems)))}")
    if not systems:
        raise ParameterFileError(f"{name}: no parameters are in it")
    return ParameterFile(systems.pop(), values, stack)


def _row(line: str, where: str) -> tuple[int, str, Value]:
    columns = line.split("\t")
    if len(columns) != _COLUMNS:
        raise ParameterFileError(f"{where}: {len(columns)} columns are not allowed, {_COLUMNS} with tabs between")
    system, _, parameter, value, kind = columns
    if not system.isdecimal() or not 1 <= int(system) <= _LARGEST_SYSTEM:
        raise ParameterFileError(f"{where}: vehicle id {system!r} is not allowed, 1 to {_LARGEST_SYSTEM}")
    if not _NAME.fullmatch(parameter):
        raise ParameterFileError(f"{where}: name {parameter!r} is not allowed, 1 to 16 letters, digits and _")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    try:
        return int(system), parameter, (checked(number, int(kind) if kind.isdecimal() else 0), int(kind))
    except ValueError as error:
        raise ParameterFileError(f"{where}: {parameter}: {value!r} of type {kind!r} is not allowed, {error}") from error


def text_of(content: ParameterFile) -> str:
    """Return a file's text, as QGroundControl writes it."""
    lines = [f"# Onboard parameters for Vehicle {content.system}", "#"]
    lines += [f"# Stack: {content.stack}", "#"] if content.stack else []
    lines += ["# Vehicle-Id Component-Id Name Value Type"]
    for name in sorted(content.values):
        value, kind = content.values[name]
        lines.append(f"{content.system}\t1\t{name}\t{written(value, kind)}\t{kind}")
    return "\n".join(lines) + "\n"


def shown(value: float, kind: int) -> str:
    """Return a value with as many digits as its type tells apart."""
    if kind != REAL32:
        return str(int(value))
    return str(np.float32(value)).removesuffix(".0")


def written(value: float, kind: int) -> str:
    """Return a value as files have it: a REAL32 always with a decimal point, by which MAVROS's mavparam knows it."""
    return np.format_float_positional(np.float32(value), trim="0") if kind == REAL32 else str(int(value))


def write(path: Path, content: ParameterFile) -> None:
    """Replace a file; at no time is there half of one.

    Raises:
        OSError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".new")
    draft.write_text(text_of(content), encoding="utf-8")
    os.replace(draft, path)
