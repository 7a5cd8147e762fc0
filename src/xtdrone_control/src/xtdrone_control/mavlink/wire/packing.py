"""MAVLink frames from tuples of field values, with pymavlink's tables.

pymavlink's message objects cost 3 us to build and pack; the tables alone 0.8 us, which is what telemetry at some
thousand messages a second needs. Everything that is sent seldom goes through message objects.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.mavlink.wire.dialect import MESSAGE_ID, MESSAGES

_HEADER = struct.Struct("<BBBBBBBHB")
_HEADER_V1 = struct.Struct("<BBBBBB")
_MAGIC_V1 = 0xFE
_MAGIC_V2 = 0xFD
_LARGEST_ID_V1 = 0xFF
COMPONENT_ID = 1  # MAV_COMP_ID_AUTOPILOT1


class PackingError(ValueError):
    """A value that a message's field cannot hold."""


def _slow_crc(data: bytes) -> int:
    return int(mavlink.x25crc(data).crc)


_crc = mavlink.mcrf4xx or _slow_crc


class Format:
    """How one message lies on the wire.

    Attributes:
        name: MAVLink name.
        number: message id.
        size: of the payload in bytes, without trailing zeros cut off.
    """

    __slots__ = ("_crc_extra", "_pack", "name", "number", "size")

    def __init__(self, name: str) -> None:
        """Look ``name`` up in the dialect.

        Raises:
            KeyError: there is no such message.
        """
        cls: Any = MESSAGES[MESSAGE_ID[name]]
        self.name = name
        self.number: int = cls.id
        self.size: int = cls.unpacker.size
        self._crc_extra = bytes([cls.crc_extra])
        self._pack = cls.unpacker.pack

    def payload(self, values: Sequence[Any]) -> bytes:
        """Return the MAVLink 2 payload of ``values``, which are in wire order with arrays laid flat.

        Raises:
            PackingError: a value of the wrong kind, or out of its field's range.
        """
        try:
            return self._pack(*values).rstrip(b"\0") or b"\0"
        except (struct.error, OverflowError) as error:
            raise PackingError(f"{self.name}: {error}") from error

    def frame(self, payload: bytes, sequence: int, system: int, component: int) -> bytes:
        """Return the MAVLink 2 frame of ``payload``."""
        number = self.number
        header = _HEADER.pack(_MAGIC_V2, len(payload), 0, 0, sequence, system, component, number & 0xFFFF, number >> 16)
        return header + payload + _crc(header[1:] + payload + self._crc_extra).to_bytes(2, "little")


@functools.cache
def _version_1() -> dict[int, tuple[int, bytes]]:
    """Return payload size and CRC extra byte of the messages that MAVLink 1 has, by message id."""
    from pymavlink.dialects.v10 import common as version_1  # seldom needed, and slow to load

    return {
        number: (cls.unpacker.size, bytes([cls.crc_extra]))
        for number, cls in version_1.mavlink_map.items()
        if number <= _LARGEST_ID_V1
    }


def as_version_1(frame: bytes) -> bytes | None:
    """Return the MAVLink 1 frame of a MAVLink 2 frame without its extension fields; None when MAVLink 1 has it not."""
    _, _, _, _, sequence, system, component, number, high = _HEADER.unpack_from(frame)
    found = _version_1().get(number | high << 16)
    if found is None:
        return None
    size, crc_extra = found
    payload = frame[_HEADER.size : -2][:size].ljust(size, b"\0")
    header = _HEADER_V1.pack(_MAGIC_V1, size, sequence, system, component, number)
    return header + payload + _crc(header[1:] + payload + crc_extra).to_bytes(2, "little")
