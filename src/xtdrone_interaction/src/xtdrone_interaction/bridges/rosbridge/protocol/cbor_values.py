"""Encoding of ROS message fields in CBOR by the rosbridge protocol.

A time or duration is an object of ``secs`` and ``nsecs``; uint8[] and char[] are a byte string, arrays of other numbers
typed arrays of RFC 8746, little endian. CBOR has NaN and infinity; JSON does not (see ``topics.message_json``).
"""

from __future__ import annotations

from typing import Any

import cbor2
import genpy
import numpy as np

_TYPED = {  # element type: tag of RFC 8746, numpy type
    "uint16": (69, "<u2"),
    "uint32": (70, "<u4"),
    "uint64": (71, "<u8"),
    "int8": (72, "i1"),
    "byte": (72, "i1"),
    "int16": (77, "<i2"),
    "int32": (78, "<i4"),
    "int64": (79, "<i8"),
    "float32": (85, "<f4"),
    "float64": (86, "<f8"),
}
_BYTES = ("uint8", "char")


def cbor_values(message: Any) -> Any:
    """Return a message's fields for CBOR."""
    if isinstance(message, (genpy.Time, genpy.Duration)):
        return {"secs": message.secs, "nsecs": message.nsecs}
    if not isinstance(message, genpy.Message):
        return message
    fields = zip(message.__slots__, message._slot_types, strict=True)
    return {name: _value(getattr(message, name), type_) for name, type_ in fields}


def _value(value: Any, type_: str) -> Any:
    element, bracket, _ = type_.partition("[")
    if not bracket:
        return cbor_values(value)
    if element in _BYTES:
        return bytes(value)
    if element in _TYPED:
        tag, layout = _TYPED[element]
        return cbor2.CBORTag(tag, np.asarray(value, layout).tobytes())
    return [cbor_values(part) for part in value]
