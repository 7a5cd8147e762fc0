"""MAVLink message types: pymavlink's common dialect, and the messages of ``common.xml`` that it lacks.

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

_CODES = {
    "char": "s",
    "uint8_t": "B",
    "int8_t": "b",
    "uint16_t": "H",
    "int16_t": "h",
    "uint32_t": "I",
    "int32_t": "i",
    "uint64_t": "Q",
    "int64_t": "q",
    "float": "f",
    "double": "d",
}
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


_MISSING = (
    message_type(
        8,
        "LINK_NODE_STATUS",
        "uint64_t timestamp, uint8_t tx_buf, uint8_t rx_buf, uint32_t tx_rate, uint32_t rx_rate,"
        "uint16_t rx_parse_err, uint16_t tx_overflows, uint16_t rx_overflows, uint32_t messages_sent,"
        "uint32_t messages_received, uint32_t messages_lost",
    ),
    message_type(
        290,
        "ESC_INFO",
        "uint8_t index, uint64_t time_usec, uint16_t counter, uint8_t count, uint8_t connection_type, uint8_t info,"
        "uint16_t[4] failure_flags, uint32_t[4] error_count, int16_t[4] temperature",
    ),
    message_type(
        291, "ESC_STATUS", "uint8_t index, uint64_t time_usec, int32_t[4] rpm, float[4] voltage, float[4] current"
    ),
    message_type(
        300,
        "PROTOCOL_VERSION",
        "uint16_t version, uint16_t min_version, uint16_t max_version,"
        "uint8_t[8] spec_version_hash, uint8_t[8] library_version_hash",
    ),
    message_type(
        334,
        "CELLULAR_STATUS",
        "uint8_t status, uint8_t failure_reason, uint8_t type, uint8_t quality,"
        "uint16_t mcc, uint16_t mnc, uint16_t lac",
    ),
    message_type(
        380,
        "TIME_ESTIMATE_TO_TARGET",
        "int32_t safe_return, int32_t land, int32_t mission_next_item, int32_t mission_end, int32_t commanded_action",
    ),
    message_type(
        395,
        "COMPONENT_INFORMATION",
        "uint32_t time_boot_ms, uint32_t general_metadata_file_crc, char[100] general_metadata_uri,"
        "uint32_t peripherals_metadata_file_crc, char[100] peripherals_metadata_uri",
    ),
    message_type(397, "COMPONENT_METADATA", "uint32_t time_boot_ms, uint32_t file_crc, char[100] uri"),
    message_type(
        400, "PLAY_TUNE_V2", "uint8_t target_system, uint8_t target_component, uint32_t format, char[248] tune"
    ),
    message_type(
        410,
        "EVENT",
        "uint8_t destination_component, uint8_t destination_system, uint32_t id, uint32_t event_time_boot_ms,"
        "uint16_t sequence, uint8_t log_levels, uint8_t[40] arguments",
    ),
    message_type(411, "CURRENT_EVENT_SEQUENCE", "uint16_t sequence, uint8_t flags"),
    message_type(
        412,
        "REQUEST_EVENT",
        "uint8_t target_system, uint8_t target_component, uint16_t first_sequence, uint16_t last_sequence",
    ),
    message_type(
        413,
        "RESPONSE_EVENT_ERROR",
        "uint8_t target_system, uint8_t target_component, uint16_t sequence, uint16_t sequence_oldest_available,"
        "uint8_t reason",
    ),
)

# messages whose extension fields pymavlink lacks
_EXTENDED = (
    message_type(
        82,
        "SET_ATTITUDE_TARGET",
        "uint32_t time_boot_ms, uint8_t target_system, uint8_t target_component, uint8_t type_mask, float[4] q,"
        "float body_roll_rate, float body_pitch_rate, float body_yaw_rate, float thrust",
        "float[3] thrust_body",
    ),
)


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


MESSAGES: dict[int, Any] = {**mavlink.mavlink_map, **{entry.id: entry for entry in _MISSING + _EXTENDED}}
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
