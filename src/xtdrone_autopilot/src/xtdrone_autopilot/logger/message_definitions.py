"""Logged messages of PX4 v1.14: their fields and binary layout.

``tables/messages.csv`` has names, types and order of PX4's ``msg/*.msg``, with ULog's names of the types. In memory,
and therefore in a log, PX4 sorts the fields of a message by descending size, with nested messages last, and pads the
message to a multiple of eight bytes.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from xtdrone_autopilot.tables.reader import read_table

from .ulog_format import TYPES, Field, Format

# topics that share another topic's message type
_ALIASES = {
    "vehicle_gps_position": "sensor_gps",
    "estimator_innovation_test_ratios": "estimator_innovations",
    "vehicle_angular_velocity_groundtruth": "vehicle_angular_velocity",
    "vehicle_attitude_groundtruth": "vehicle_attitude",
    "vehicle_local_position_groundtruth": "vehicle_local_position",
}

_WORD = 8  # bytes, PX4's alignment of message sizes


@cache
def _messages() -> dict[str, list[Field]]:
    """Return the fields of each message in declaration order."""
    found: dict[str, list[Field]] = {}
    columns = {"topic": str, "field": str, "type": str, "length": int}
    for topic, name, kind, length in read_table("messages", columns):
        found.setdefault(topic, []).append(Field(kind, length, name))
    return found


def _size(field: Field) -> int:
    """Return the element size by which PX4 sorts the fields; 0 for a nested message."""
    return np.dtype(TYPES[field.type]).itemsize if field.type in TYPES else 0


def message_format(name: str) -> Format:
    """Return the format in which PX4 v1.14 logs topic ``name``.

    Raises:
        KeyError: the topic is not logged.
    """
    fields = sorted(_messages()[_ALIASES.get(name, name)], key=_size, reverse=True)  # stable, like PX4's generator
    nested = tuple(message_format(kind) for kind in dict.fromkeys(f.type for f in fields if f.type not in TYPES))
    size = Format(name, tuple(fields), nested).inner_dtype.itemsize
    if size % _WORD:
        fields.append(Field("uint8_t", _WORD - size % _WORD, "_padding0"))
    return Format(name, tuple(fields), nested)
