"""Messages of any type with random values, for tests of conversions."""

from __future__ import annotations

from typing import Any

import genmsg.msgs
import genpy
import numpy as np

from xtdrone_interaction.topics.field_paths import INTEGERS
from xtdrone_interaction.topics.message_classes import class_of_field

_LETTERS = "abc xyz äß東"
_LONGEST = 4  # elements of an array of variable length


def random_message(kind: type[Any], random: np.random.Generator) -> Any:
    """Return a message of a class; a header's ``seq`` is 0, which ROS 2 does not have."""
    message = kind()
    for name, type_ in zip(kind.__slots__, kind._slot_types, strict=True):
        value = 0 if (kind._type, name) == ("std_msgs/Header", "seq") else _value(kind, type_, random)
        setattr(message, name, value)
    return message


def _value(owner: type[Any], type_: str, random: np.random.Generator) -> Any:
    base, is_array, length = genmsg.msgs.parse_type(type_)
    if not is_array:
        return _single(owner, base, random)
    count = int(random.integers(_LONGEST)) if length is None else length
    values = [_single(owner, base, random) for _ in range(count)]
    return bytes(values) if base in ("uint8", "char") else values


def _single(owner: type[Any], base: str, random: np.random.Generator) -> Any:
    if base == "string":
        return "".join(random.choice(list(_LETTERS), int(random.integers(9))))
    if base == "bool":
        return bool(random.integers(2))
    if base == "float32":
        return float(np.float32(random.normal()))
    if base == "float64":
        return float(random.choice([random.normal(), np.inf, -0.0, 1e300]))
    if base == "time":
        return genpy.Time(int(random.integers(1 << 31)), int(random.integers(10**9)))
    if base == "duration":
        return genpy.Duration(int(random.integers(-(1 << 30), 1 << 30)), int(random.integers(10**9)))
    if base in ("byte", "char") or base.endswith("int8"):
        return int(random.integers(0, 128)) if base != "uint8" else int(random.integers(256))
    if base in INTEGERS:
        bits = int(base.rpartition("int")[2])
        low, high = (0, 2**bits - 1) if base[0] == "u" else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return int(random.integers(low, high, dtype=np.uint64 if base[0] == "u" else np.int64, endpoint=True))
    return random_message(class_of_field(owner, base), random)
