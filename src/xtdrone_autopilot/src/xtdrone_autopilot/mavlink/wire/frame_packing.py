"""MAVLink frames from tuples of field values.

The wire formats are pymavlink's; ``xtdrone_native.mavlink_wire`` packs and frames, as needed for telemetry of several
thousand messages per second. Rare messages use pymavlink's message objects.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Sequence
from typing import Any

from xtdrone_native import mavlink_wire

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID, MESSAGES

_HEADER = struct.Struct("<BBBBBBBHB")
_HEADER_V1 = struct.Struct("<BBBBBB")
_MAGIC_V1 = 0xFE
_LARGEST_ID_V1 = 0xFF
COMPONENT_ID = 1  # MAV_COMP_ID_AUTOPILOT1


class PackingError(ValueError):
    """A value that a message's field cannot hold."""


class Format:
    """Wire format of one message.

    Attributes:
        name: MAVLink name.
        number: message id.
        size: payload size in bytes, including trailing zeros.
        wire: the compiled format.
    """

    __slots__ = ("_pack", "name", "number", "size", "wire")

    def __init__(self, name: str) -> None:
        """Look up message ``name`` in the dialect.

        Raises:
            KeyError: the dialect does not define the message.
        """
        cls: Any = MESSAGES[MESSAGE_ID[name]]
        self.name = name
        self.number: int = cls.id
        self.size: int = cls.unpacker.size
        self.wire = compiled(cls)
        self._pack = cls.unpacker.pack

    def payload(self, values: Sequence[Any]) -> bytes:
        """Return the MAVLink 2 payload of ``values``, given in wire order with arrays flattened.

        Raises:
            PackingError: a value of the wrong type, or outside the range of its field.
        """
        payload = self.wire.payload(values)
        return self.general_payload(values) if payload is None else payload

    def general_payload(self, values: Sequence[Any]) -> bytes:
        """Return the payload, more slowly than ``payload``, for all values of ``struct`` and with its error texts."""
        try:
            return bytes(self._pack(*values).rstrip(b"\0") or b"\0")
        except (struct.error, OverflowError) as error:
            raise PackingError(f"{self.name}: {error}") from error

    def frame(self, payload: bytes, sequence: int, system: int, component: int) -> bytes:
        """Return the MAVLink 2 frame of ``payload``."""
        return self.wire.frame(payload, sequence, system, component)


def compiled(cls: Any) -> mavlink_wire.Format:
    """Return the compiled format of a message type of the dialect."""
    return mavlink_wire.Format(cls.id, cls.crc_extra, cls.unpacker.format)


@functools.cache
def _version_1() -> dict[int, tuple[int, bytes]]:
    """Return payload size and CRC extra byte of MAVLink 1's messages, by message id."""
    from pymavlink.dialects.v10 import common as version_1  # rarely needed, and slow to load

    return {
        number: (cls.unpacker.size, bytes([cls.crc_extra]))
        for number, cls in version_1.mavlink_map.items()
        if number <= _LARGEST_ID_V1
    }


def as_version_1(frame: bytes) -> bytes | None:
    """Convert a MAVLink 2 frame to MAVLink 1 without extension fields; None if MAVLink 1 lacks the message."""
    _, _, _, _, sequence, system, component, number, high = _HEADER.unpack_from(frame)
    found = _version_1().get(number | high << 16)
    if found is None:
        return None
    size, crc_extra = found
    payload = frame[_HEADER.size : -2][:size].ljust(size, b"\0")
    header = _HEADER_V1.pack(_MAGIC_V1, size, sequence, system, component, number)
    return header + payload + mavlink_wire.checksum(header[1:] + payload + crc_extra).to_bytes(2, "little")
