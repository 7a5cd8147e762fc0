"""MAVLink 2 frames from tuples of field values, with pymavlink's tables.

pymavlink's message objects cost 3 us to build and pack; the tables alone 0.8 us, which is what telemetry at some
thousand messages a second needs. Everything that is sent seldom goes through message objects.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

_HEADER = struct.Struct("<BBBBBBBHB")
_MAGIC_V2 = 0xFD
MESSAGE_ID: dict[str, int] = {cls.msgname: number for number, cls in mavlink.mavlink_map.items()}


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
    """

    __slots__ = ("_crc_extra", "_pack", "name", "number")

    def __init__(self, name: str) -> None:
        """Look ``name`` up in the dialect.

        Raises:
            KeyError: there is no such message.
        """
        cls: Any = mavlink.mavlink_map[MESSAGE_ID[name]]
        self.name = name
        self.number: int = cls.id
        self._crc_extra = bytes([cls.crc_extra])
        self._pack = cls.unpacker.pack

    def frame(self, values: Sequence[Any], sequence: int, system: int, component: int) -> bytes:
        """Return the frame of ``values``, which are in wire order with arrays laid flat.

        Raises:
            PackingError: a value of the wrong kind, or out of its field's range.
        """
        try:
            payload = self._pack(*values).rstrip(b"\0") or b"\0"
        except (struct.error, OverflowError) as error:
            raise PackingError(f"{self.name}: {error}") from error
        number = self.number
        header = _HEADER.pack(_MAGIC_V2, len(payload), 0, 0, sequence, system, component, number & 0xFFFF, number >> 16)
        return header + payload + _crc(header[1:] + payload + self._crc_extra).to_bytes(2, "little")
