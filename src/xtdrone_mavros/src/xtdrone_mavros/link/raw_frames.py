"""Conversion between MAVLink frames and mavros_msgs/Mavlink.

Follows ``mavros_msgs/mavlink.h``: header fields as on the wire, the payload in little-endian 8-byte words padded with
zeros, the checksum as on the wire, and the 13 bytes of the signature if present.
"""

from __future__ import annotations

import struct
from typing import Any

from mavros_msgs.msg import Mavlink
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGES

_HEAD_1 = struct.Struct("<BBBBBB")  # magic, length, sequence, system, component, message
_HEAD_2 = struct.Struct(
    "<BBBBBBBHB"
)  # magic, length, flags, flags, sequence, system, component, message, its high byte
_SIGNED = 0x01
_SIGNATURE = 13
_HIGHEST_1 = 0xFF
_HIGHEST_2 = 0xFFFFFF


class RawFrameError(ValueError):
    """A mavros_msgs/Mavlink is not a valid MAVLink frame."""


def fill(message: Mavlink, frame: bytes) -> None:
    """Fill ``message``, except its header's stamp, from a frame yielded by ``codec.split``."""
    message.magic = frame[0]
    if message.magic == Mavlink.MAVLINK_V20:
        head = _HEAD_2
        _, length, incompatible, message.compat_flags, *ids, low, high = head.unpack_from(frame)
        message.msgid = low | high << 16
    else:
        head = _HEAD_1
        _, length, *ids, message.msgid = head.unpack_from(frame)
        incompatible = message.compat_flags = 0
    message.len, message.incompat_flags = length, incompatible
    message.seq, message.sysid, message.compid = ids
    end = head.size + length
    payload = frame[head.size : end]
    words = (length + 7) // 8
    message.payload64 = struct.unpack(f"<{words}Q", payload.ljust(8 * words, b"\0"))
    message.checksum = frame[end] | frame[end + 1] << 8
    message.signature = frame[end + 2 : end + 2 + _SIGNATURE] if incompatible & _SIGNED else b""
    good = message.checksum == _checksum(frame[1:end], message.msgid)
    message.framing_status = Mavlink.FRAMING_OK if good else Mavlink.FRAMING_BAD_CRC


def to_frame(message: Mavlink) -> bytes:
    """Return the frame of a message, with the checksum and sequence number of the message.

    Raises:
        RawFrameError: the fields do not form a frame.
    """
    payload = struct.pack(f"<{len(message.payload64)}Q", *message.payload64)
    if message.len > len(payload):
        raise RawFrameError(f"len is {message.len}, but payload64 has {len(payload)} bytes")
    if len(message.signature) != _SIGNATURE * bool(message.incompat_flags & _SIGNED):
        raise RawFrameError(f"the signature has {len(message.signature)} bytes; {_SIGNATURE} if it is signed, else 0")
    ids = message.seq, message.sysid, message.compid
    number = message.msgid
    if message.magic == Mavlink.MAVLINK_V20 and number <= _HIGHEST_2:
        flags = message.incompat_flags, message.compat_flags
        head = _HEAD_2.pack(message.magic, message.len, *flags, *ids, number & 0xFFFF, number >> 16)
    elif message.magic == Mavlink.MAVLINK_V10 and number <= _HIGHEST_1 and not message.signature:
        head = _HEAD_1.pack(message.magic, message.len, *ids, number)
    else:
        raise RawFrameError(f"magic {message.magic} with msgid {number} is not allowed, 254 (1) or 253 (2) is allowed")
    return head + payload[: message.len] + message.checksum.to_bytes(2, "little") + bytes(message.signature)


def _checksum(covered: bytes, number: int) -> int:
    known: Any = MESSAGES.get(number)
    extra = known.crc_extra if known is not None else 0  # as MAVLink's C library does for unknown messages
    return int(mavlink.x25crc(covered + bytes([extra])).crc)
