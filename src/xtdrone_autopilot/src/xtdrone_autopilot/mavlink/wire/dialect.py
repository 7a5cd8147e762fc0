"""MAVLink message types: pymavlink's common dialect, and the messages of ``common.xml`` that it lacks.

``tables/mavlink_messages.csv`` describes the latter: ``type name`` or ``type[count] name`` of each field.

A message type describes the wire format of a message with the attributes of pymavlink's message classes: ``id``,
``msgname``, ``fieldnames``, ``ordered_fieldnames``, ``fieldtypes``, ``lengths``, ``crc_extra``, ``unpacker``.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.tables.reader import read_table

_TYPES = "char uint8_t int8_t uint16_t int16_t uint32_t int32_t uint64_t int64_t float double"
_CODES = dict(zip(_TYPES.split(), "sBbHhIiQqfd", strict=True))
_FIELD = re.compile(r"(\w+?)(?:\[(\d+)\])? (\w+)")


@dataclass(frozen=True)
class MessageType:
    """Wire format of one message; see the module docstring."""

    id: int
    msgname: str
    fieldnames: tuple[str, ...]
    ordered_fieldnames: tuple[str, ...]
    fieldtypes: tuple[str, ...]
    lengths: tuple[int, ...]
    crc_extra: int
    unpacker: struct.Struct


def _fields(name: str, text: str) -> list[tuple[str, int, str]]:
    """Return type, count (0 for no array) and name of each field.

    Raises:
        ValueError: a field of another form.
    """
    parsed = []
    for field in filter(None, map(str.strip, text.split(","))):
        match = _FIELD.fullmatch(field)
        if match is None:
            raise ValueError(f"{name}: field {field!r} is not of the form 'type name' or 'type[count] name'")
        kind, count, label = match.groups()
        parsed.append((kind, int(count or 0), label))
    return parsed


def message_type(number: int, name: str, fields: str, extensions: str = "") -> MessageType:
    """Return the type of a message described as in ``common.xml``.

    Args:
        number: message id.
        name: message name.
        fields: ``type name`` or ``type[count] name`` of each field in the order of the XML, separated by commas.
        extensions: extension fields in the same form.

    Returns:
        The type, with fields in wire order (by size) and the CRC extra byte computed from them
        (https://mavlink.io/en/guide/serialization.html).
    """
    parsed, added = _fields(name, fields), _fields(name, extensions)
    wire = sorted(parsed, key=lambda entry: -struct.calcsize(_CODES[entry[0]]))
    signature = f"{name} ".encode()
    for kind, count, label in wire:
        signature += f"{kind} {label} ".encode() + (bytes([count]) if count else b"")
    checksum = int(mavlink.x25crc(signature).crc)
    parsed += added
    wire += added
    return MessageType(
        id=number,
        msgname=name,
        fieldnames=tuple(label for _, _, label in parsed),
        ordered_fieldnames=tuple(label for _, _, label in wire),
        fieldtypes=tuple(kind for kind, _, _ in parsed),
        lengths=tuple(1 if kind == "char" else count or 1 for kind, count, _ in wire),
        crc_extra=checksum & 0xFF ^ checksum >> 8,
        unpacker=struct.Struct("<" + "".join(f"{count or ''}{_CODES[kind]}" for kind, count, _ in wire)),
    )


def _read_messages() -> dict[int, MessageType]:
    """Return, by id, the messages that pymavlink lacks, and those whose extension fields it lacks."""
    columns = {"id": int, "message": str, "fields": str, "extensions": str}
    return {row[0]: message_type(*row) for row in read_table("mavlink_messages", columns)}


class _MessageObject(mavlink.MAVLink_message):
    """A message of a type without a pymavlink class, with the ``pack`` of pymavlink's message objects."""

    def __init__(self, kind: MessageType, values: Mapping[str, Any]) -> None:
        super().__init__(kind.id, kind.msgname)
        self._kind = kind
        self.fieldnames, self.fieldtypes = kind.fieldnames, kind.fieldtypes
        for name in kind.fieldnames:
            setattr(self, name, values[name])

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        flat: list[Any] = []
        for name in self._kind.ordered_fieldnames:
            value = getattr(self, name)
            flat += value if isinstance(value, (list, tuple)) else [value]
        payload = self._kind.unpacker.pack(*flat)
        return bytes(self._pack(mav, self._kind.crc_extra, payload, force_mavlink1=force_mavlink1))


MESSAGES: dict[int, Any] = {**mavlink.mavlink_map, **_read_messages()}
MESSAGE_ID: dict[str, int] = {entry.msgname: number for number, entry in MESSAGES.items()}


def message(name: str, values: Mapping[str, Any]) -> Any:
    """Return message ``name`` as a message object that packs like pymavlink's.

    Args:
        name: MAVLink name.
        values: values of all fields by name; arrays as lists, text as bytes.

    Raises:
        KeyError: the dialect does not define the message, or a value is missing.
    """
    kind = MESSAGES[MESSAGE_ID[name]]
    return _MessageObject(kind, values) if isinstance(kind, MessageType) else kind(**values)
