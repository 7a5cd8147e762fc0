"""Paths of fields in messages, such as ``pose.position.x`` or ``values[3]``: parsed, listed and read."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import genmsg.msgs
import genpy

from xtdrone_interaction.topics.message_classes import class_of_field

_STEP = re.compile(r"(?:^|\.)(?P<name>[A-Za-z]\w*)|\[(?P<index>\d{1,9})\]")
_LONGEST_PATH = 400  # characters
_LONGEST_FIXED = 64  # elements of an array of fixed length that are listed one by one
INTEGERS = {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)} | {"byte", "char"}
FLOATS = {"float32", "float64"}
TIMES = {"time", "duration"}
NUMBERS = INTEGERS | FLOATS | TIMES | {"bool"}
"""Types of fields that can be plotted; times are in s."""


class FieldPathError(ValueError):
    """A path that is malformed, or that a message does not have."""


@dataclass(frozen=True)
class Field:
    """One field of a type of messages.

    Attributes:
        path: such as ``pose.position.x``; elements of an array of any length have no index: ``values[]``.
        type: of ROS, such as ``float64``.
    """

    path: str
    type: str

    @property
    def plottable(self) -> bool:
        """Whether it is a number; an element of an array needs its index to be plotted."""
        return self.type in NUMBERS


def parse_path(text: str) -> tuple[str | int, ...]:
    """Return the steps of a path: names of fields, and indices of elements from 0.

    Raises:
        FieldPathError: it is malformed.
    """
    steps: list[str | int] = []
    at = 0
    while isinstance(text, str) and at < len(text) <= _LONGEST_PATH and text[0] != ".":
        match = _STEP.match(text, at)
        if match is None:
            break
        steps.append(match["name"] if match["name"] is not None else int(match["index"]))
        at = match.end()
    if not steps or at != len(text) or not isinstance(steps[0], str):
        raise FieldPathError(f"field: {text!r} is not allowed, a path such as pose.position.x or values[3]")
    return tuple(steps)


def value_at(message: Any, text: str) -> Any:
    """Return the value of a field.

    Raises:
        FieldPathError: the path is malformed, or the message does not have it.
    """
    value = message
    for step in parse_path(text):
        value = _step(value, step, text)
    return value


def number_at(message: Any, text: str) -> float:
    """Return a field as a number: times and durations in s, false and true as 0 and 1.

    Raises:
        FieldPathError: the path is malformed, or the message does not have it, or it is no number.
    """
    value = value_at(message, text)
    if isinstance(value, genpy.TVal):
        return float(value.to_sec())
    if not isinstance(value, (bool, int, float)):
        raise FieldPathError(f"field: {text} is {_described(value)}, which cannot be plotted; a number can")
    return float(value)


def check_number(message_class: type[Any], text: str) -> None:
    """Check before the first message that a type has a path, and that it is a number.

    Raises:
        FieldPathError: as ``number_at``; elements of arrays of any length are assumed to exist.
    """
    owner, kind = message_class, ""  # class of the fields, and the type reached so far
    for step in parse_path(text):
        base, is_array, length = genmsg.msgs.parse_type(kind) if kind else ("", False, None)
        if isinstance(step, int):
            if not is_array or (length is not None and step >= length):
                raise FieldPathError(_missing(text, step, f"{kind}"))
            kind = base
            continue
        if is_array:
            raise FieldPathError(f"field: {text}: {kind} needs an index before {step!r}, such as [0]")
        if kind in NUMBERS or kind == "string":
            raise FieldPathError(_missing(text, step, f"no fields in {kind}"))
        owner = class_of_field(owner, kind) if kind else owner
        types = dict(zip(owner.__slots__, owner._slot_types, strict=True))
        if step not in types:
            raise FieldPathError(_missing(text, step, ", ".join(types) or f"no fields in {owner._type}"))
        kind = types[step]
    if kind not in NUMBERS:
        raise FieldPathError(f"field: {text} is {kind}, which cannot be plotted; a number can")


def fields_of(message_class: type[Any], prefix: str = "") -> Iterator[Field]:
    """Yield the fields of a type that hold values, nested ones in their place."""
    for name, kind in zip(message_class.__slots__, message_class._slot_types, strict=True):
        base, is_array, length = genmsg.msgs.parse_type(kind)
        yield from _fields(message_class, base, _elements(f"{prefix}{name}", is_array, length))


def _fields(message_class: type[Any], base: str, paths: Sequence[str]) -> Iterator[Field]:
    for path in paths:
        if base in NUMBERS or base == "string":
            yield Field(path, base)
        else:
            yield from fields_of(class_of_field(message_class, base), f"{path}.")


def _elements(path: str, is_array: bool, length: int | None) -> list[str]:
    if not is_array:
        return [path]
    if length is None or length > _LONGEST_FIXED:
        return [f"{path}[]"]
    return [f"{path}[{i}]" for i in range(length)]


def _step(value: Any, step: str | int, text: str) -> Any:
    if isinstance(step, int):
        if not isinstance(value, (list, tuple, bytes)):
            raise FieldPathError(_missing(text, step, f"no elements in {_described(value)}"))
        if step >= len(value):
            raise FieldPathError(_missing(text, step, f"{len(value)} elements now, from 0"))
        return value[step]
    if step not in getattr(value, "__slots__", ()) or isinstance(value, genpy.TVal):
        slots = value.__slots__ if isinstance(value, genpy.Message) else ()
        raise FieldPathError(_missing(text, step, ", ".join(slots) or f"no fields in {_described(value)}"))
    return getattr(value, step)


def _missing(text: str, step: str | int, there: str) -> str:
    shown = f"[{step}]" if isinstance(step, int) else repr(step)
    return f"field: {text}: {shown} is not there, but {there}"


_NAMES: list[tuple[type | tuple[type, ...], Callable[[Any], str]]] = [
    (bytes, lambda value: f"an array of {len(value)} bytes"),
    ((list, tuple), lambda value: f"an array of {len(value)}"),
    (str, lambda _: "a text"),
    (genpy.TVal, lambda _: "a time"),
    (genpy.Message, lambda value: f"a {value._type}"),
]


def _described(value: Any) -> str:
    return next((name(value) for kind, name in _NAMES if isinstance(value, kind)), "a number")
