"""Packing of MAVLink messages with values from ROS, and error texts for values that do not fit.

Fields of ROS messages are wider than those of MAVLink: 64-bit floats become 32-bit ones, and numbers are scaled to
integers. All range checks of MAVLink fields happen here.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from typing import Any

FLOAT32_MAX = (2.0 - 2.0**-23) * 2.0**127
FLOAT32_RANGE = f"{-FLOAT32_MAX:.4g} to {FLOAT32_MAX:.4g}"
_BITS = {f"{sign}int{bits}_t": bits for sign in ("", "u") for bits in (8, 16, 32, 64)}


class FieldError(ValueError):
    """A value does not fit into a field of a MAVLink message.

    Attributes:
        field: message and field name, e.g. ``SET_HOME_POSITION.latitude``.
        value: the rejected value.
        allowed: the field's range, in words.
    """

    def __init__(self, field: str, value: Any, allowed: str) -> None:
        """Store field, value and range."""
        super().__init__(f"{field} is {value}; {allowed} is allowed")
        self.field = field
        self.value = value
        self.allowed = allowed


def pack(message: Any, packer: Any) -> bytes:
    """Return the frame of a pymavlink message object.

    Args:
        message: the message.
        packer: pymavlink's ``MAVLink`` with the sequence number and ids; unchanged on error.

    Raises:
        FieldError: a value does not fit into its field.
    """
    try:
        return bytes(message.pack(packer))
    except (struct.error, OverflowError, TypeError) as error:
        for name, kind, value in _fields(message):
            allowed = _range(kind)
            if not _fits(kind, value):
                raise FieldError(f"{message.msgname}.{name}", value, allowed) from error
        raise


def require_finite(message: Any, free: Collection[str] = ()) -> None:
    """Check that every number of a pymavlink message object is finite, except in the fields ``free``.

    Raises:
        FieldError: a number is not finite.
    """
    for name, kind, value in _fields(message):
        if kind in ("float", "double") and not abs(value) <= FLOAT32_MAX and name.partition("[")[0] not in free:
            raise FieldError(f"{message.msgname}.{name}", value, FLOAT32_RANGE)


def whole(value: float) -> int | float:
    """Round a number to an integer; return a non-finite one unchanged, so that :func:`pack` rejects it."""
    return round(value) if abs(value) <= FLOAT32_MAX else value


def source(message: Any, value: Any) -> str | None:
    """Return the field of a ROS message that holds ``value`` or its negative, e.g. ``pose.position.x``; None if none.

    Frame conversions permute and negate numbers, so this finds the origin of a value.
    """
    if not isinstance(value, (int, float)):
        return None
    return next((name for name, found in _leaves(message, "") if found in (value, -value)), None)


def _fields(message: Any) -> Iterator[tuple[str, str, Any]]:
    """Yield name, type and value of each number in a MAVLink message, array elements one by one."""
    for name, kind in zip(message.fieldnames, message.fieldtypes, strict=True):
        value = getattr(message, name)
        if isinstance(value, (list, tuple)):
            yield from ((f"{name}[{index}]", kind, item) for index, item in enumerate(value))
        elif kind != "char":
            yield name, kind, value


def _fits(kind: str, value: Any) -> bool:
    letter = {"float": "<f", "double": "<d"}.get(kind)
    if letter is None:
        low, high = _limits(kind)
        return isinstance(value, int) and low <= value <= high
    try:
        struct.pack(letter, value)
    except (struct.error, OverflowError, TypeError):
        return False
    return True


def _limits(kind: str) -> tuple[int, int]:
    bits = _BITS[kind]
    return (0, (1 << bits) - 1) if kind.startswith("u") else (-(1 << bits - 1), (1 << bits - 1) - 1)


def _range(kind: str) -> str:
    if kind == "float":
        return FLOAT32_RANGE
    if kind == "double":
        return "a number"
    low, high = _limits(kind)
    return f"{low} to {high}"


def _leaves(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield name and value of each number in a ROS message."""
    if isinstance(value, (list, tuple)):
        for index, item in enumerate(value):
            yield from _leaves(item, f"{name}[{index}]")
    elif isinstance(value, (int, float)):
        yield name, value
    else:
        for slot in getattr(value, "__slots__", ()):
            yield from _leaves(getattr(value, slot), f"{name}.{slot}" if name else slot)
