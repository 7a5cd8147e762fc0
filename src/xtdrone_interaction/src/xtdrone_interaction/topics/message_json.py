"""Messages of any type as JSON and back.

Numbers are JSON's; those that JSON does not have are the texts ``NaN``, ``Infinity`` and ``-Infinity``, or null as the
rosbridge protocol has it. Times are ``{"secs": s, "nsecs": ns}``. Arrays of bytes (``uint8[]``, ``char[]``) are texts
in base 64. All as rosbridge and roslibjs write them (https://github.com/RobotWebTools/rosbridge_suite).
"""

from __future__ import annotations

import base64
import binascii
import math
import sys
from collections.abc import Callable, Mapping
from enum import Enum
from functools import cache
from typing import Any

import genmsg.msgs
import genpy

from xtdrone_common.files import shortened
from xtdrone_interaction.topics.field_paths import FLOATS, INTEGERS, TIMES
from xtdrone_interaction.topics.message_classes import class_of_field

Json = Any
_BYTES = {"uint8", "char"}
_TIME_CLASSES = {"time": genpy.Time, "duration": genpy.Duration}
_RANGES = {
    **{f"int{bits}": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) for bits in (8, 16, 32, 64)},
    **{f"uint{bits}": (0, 2**bits - 1) for bits in (8, 16, 32, 64)},
    "byte": (-128, 127),
    "char": (0, 255),
}
_NOT_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_SECONDS = {"time": (0, 2**32 - 1), "duration": (-(2**31), 2**31 - 1)}
_LARGEST = {"float32": (2.0 - 2.0**-23) * 2.0**127, "float64": sys.float_info.max}
_LONGEST_TEXT = 4000  # characters of a text where arrays are shortened
_MOST_SHOWN = 60  # characters of a value in a message


class NotFinite(Enum):
    """How numbers are written that JSON does not have."""

    TEXT = "text"  # "NaN", "Infinity", "-Infinity"
    NULL = "null"  # null


class MessageJsonError(ValueError):
    """JSON that is no message of its type."""


def to_json(message: Any, *, not_finite: NotFinite = NotFinite.TEXT, longest: int | None = None) -> Json:
    """Return a message as what ``json.dumps`` takes, without NaN or infinity.

    Args:
        message: of any type.
        not_finite: how NaN and infinity are written.
        longest: elements of an array that is written whole; a longer one becomes ``{"length": n, "first": [...]}`` with
            as many elements (of bytes, their text in base 64), and a text of more than 4000 characters likewise.
            None for no limit.
    """
    kind: Any = type(message)
    return _writer(kind, not_finite, longest)(message)


def from_json(kind: type[Any], value: Json, now: genpy.Time | None = None) -> Any:
    """Return the message that JSON describes; fields that are missing keep their defaults.

    Args:
        kind: class of the message.
        value: parsed JSON. Times may be a number in s too, arrays of bytes a list of numbers, NaN null.
        now: with a time, each header in ``value`` that lacks a stamp gets this one, and so does each time that is the
            text "now" (rosbridge's message_conversion.py); a header that is missing altogether keeps its default.

    Raises:
        MessageJsonError: it has a field that the type does not have, or a value that the field cannot hold; the text
            names field, value and what is allowed.
    """
    return _read_message(kind, value, "", now)


# writing


def _number(not_finite: NotFinite) -> Callable[[float], Json]:
    if not_finite is NotFinite.NULL:
        return lambda value: value if math.isfinite(value) else None

    def write(value: float) -> Json:
        if math.isfinite(value):
            return value
        return "NaN" if math.isnan(value) else "Infinity" if value > 0.0 else "-Infinity"

    return write


def _write_time(value: genpy.TVal) -> Json:
    return {"secs": value.secs, "nsecs": value.nsecs}


def _write_bytes(value: Any) -> str:
    return base64.b64encode(bytes(value)).decode("ascii")


@cache
def _writer(kind: Any, not_finite: NotFinite, longest: int | None) -> Callable[[Any], Json]:
    """Return the function that writes messages of a class."""
    fields = [
        (slot, _field_writer(kind, slot_type, not_finite, longest))
        for slot, slot_type in zip(kind.__slots__, kind._slot_types, strict=True)
    ]
    return lambda message: {slot: write(getattr(message, slot)) for slot, write in fields}


def _field_writer(
    owner: type[Any], slot_type: str, not_finite: NotFinite, longest: int | None
) -> Callable[[Any], Json]:
    base, is_array, _ = genmsg.msgs.parse_type(slot_type)
    if is_array and base in _BYTES:
        return _shortened(_write_bytes, longest)
    single: Callable[[Any], Json]
    if base in FLOATS:
        single = _number(not_finite)
    elif base in INTEGERS:
        single = int
    elif base == "bool":
        single = bool
    elif base == "string":
        single = _shortened(_write_text, None if longest is None else _LONGEST_TEXT)
    elif base in TIMES:
        single = _write_time
    else:
        nested: Any = class_of_field(owner, base)
        single = _writer(nested, not_finite, longest)
    return _shortened(lambda values: [single(value) for value in values], longest) if is_array else single


def _write_text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _shortened(write: Callable[[Any], Json], longest: int | None) -> Callable[[Any], Json]:
    if longest is None:
        return write
    most = longest  # for mypy: never None below
    return lambda value: write(value) if len(value) <= most else {"length": len(value), "first": write(value[:most])}


# reading


def _refuse(path: str, value: Json, allowed: str) -> MessageJsonError:
    return MessageJsonError(f"{path or 'message'}: {shortened(repr(value), _MOST_SHOWN)} is not allowed, {allowed}")


def _read_message(kind: type[Any], value: Json, path: str, now: genpy.Time | None) -> Any:
    if not isinstance(value, Mapping):
        raise _refuse(path, value, f"an object with the fields of {kind._type}")
    message = kind()
    if now is not None and kind._type == "std_msgs/Header":
        message.stamp = now
    types = dict(zip(kind.__slots__, kind._slot_types, strict=True))
    for name, field in value.items():
        if name not in types:
            fields = ", ".join(types) or "no fields"
            raise MessageJsonError(f"{path or 'message'}: {name!r} is no field of {kind._type}, which has {fields}")
        setattr(message, name, _read_field(kind, types[name], field, f"{path}.{name}" if path else name, now))
    return message


def _read_field(owner: type[Any], slot_type: str, value: Json, path: str, now: genpy.Time | None) -> Any:
    base, is_array, length = genmsg.msgs.parse_type(slot_type)
    if not is_array:
        return _read_single(owner, base, value, path, now)
    if base in _BYTES and isinstance(value, str):
        return _checked_length(_read_bytes(value, path), length, value, path)
    if not isinstance(value, (list, tuple)):
        raise _refuse(path, value, f"a list of {base}")
    elements = [_read_single(owner, base, element, f"{path}[{i}]", now) for i, element in enumerate(value)]
    return _checked_length(bytes(elements) if base in _BYTES else elements, length, value, path)


def _checked_length(elements: Any, length: int | None, value: Json, path: str) -> Any:
    if length is not None and len(elements) != length:
        raise _refuse(path, value, f"{length} elements, not {len(elements)}")
    return elements


def _read_bytes(value: str, path: str) -> bytes:
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError) as error:
        raise _refuse(path, value, "bytes in base 64") from error


def _read_single(owner: type[Any], base: str, value: Json, path: str, now: genpy.Time | None) -> Any:
    if base in FLOATS:
        return _read_float(base, value, path)
    if base in INTEGERS:
        return _read_integer(base, value, path)
    if base == "bool":
        if type(value) is not bool and value not in (0, 1):
            raise _refuse(path, value, "true or false")
        return bool(value)
    if base == "string":
        return _read_text(value, path)
    if base in TIMES:
        return now if base == "time" and value == "now" and now is not None else _read_time(base, value, path)
    return _read_message(class_of_field(owner, base), value, path, now)


def _read_float(base: str, value: Json, path: str) -> float:
    if value is None:
        return math.nan
    if isinstance(value, str) and value in _NOT_FINITE:
        return _NOT_FINITE[value]
    if type(value) not in (int, float):
        raise _refuse(path, value, "a number, NaN, Infinity or -Infinity")
    if not -_LARGEST[base] <= value <= _LARGEST[base]:
        raise _refuse(path, value, f"a number up to {_LARGEST[base]:.4g}")
    return float(value)


def _read_integer(base: str, value: Json, path: str) -> int:
    low, high = _RANGES[base]
    whole = type(value) is int or (type(value) is float and value.is_integer())
    if not whole or not low <= value <= high:
        raise _refuse(path, value, f"an integer from {low} to {high}")
    return int(value)


def _read_text(value: Json, path: str) -> str:
    if not isinstance(value, str):
        raise _refuse(path, value, "a text")
    try:
        value.encode()
    except UnicodeEncodeError as error:  # half a surrogate pair, which JSON can carry
        raise _refuse(path, value, "a text of Unicode characters") from error
    return value


def _read_time(base: str, value: Json, path: str) -> genpy.TVal:
    low, high = _SECONDS[base]
    if type(value) in (int, float) and math.isfinite(value) and low <= value <= high:
        return _TIME_CLASSES[base].from_sec(value)
    if isinstance(value, Mapping) and set(value) in ({"secs", "nsecs"}, {"sec", "nanosec"}):
        secs, nsecs = (value["secs"], value["nsecs"]) if "secs" in value else (value["sec"], value["nanosec"])
        if type(secs) is int and type(nsecs) is int and low <= secs <= high and 0 <= nsecs < 10**9:
            return _TIME_CLASSES[base](secs, nsecs)
    raise _refuse(path, value, f"s from {low} to {high}, or secs in that range and nsecs from 0 to 999999999")
