"""MAVLink frames: splitting of datagrams and decoding of frames.

Messages are decoded by ``xtdrone_native.mavlink_wire`` with pymavlink's formats, into a named tuple with MAVLink's
field names. Messages with text are rare and use pymavlink's ``MAVLink.decode``.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from pymavlink.dialects.v20 import common as mavlink
from xtdrone_native import mavlink_wire

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID, MESSAGES
from xtdrone_autopilot.mavlink.wire.frame_packing import compiled

Frame = tuple[int, int, int, bytes]
"""Message id, system id, component id and bytes of a frame."""
Decoder = Callable[[bytes], Any]

_MAGIC_V1 = 0xFE
_MAGIC_V2 = 0xFD
_FLAG_SIGNED = 0x01
_SIGNATURE_LENGTH = 13
_HEADER_V1 = 6
_HEADER_V2 = 10


class FrameError(ValueError):
    """A MAVLink frame or datagram that cannot be used."""


def message_name(number: int) -> str:
    """Return the name of a message id, or ``#id`` if the dialect does not define it."""
    cls = MESSAGES.get(number)
    return f"#{number}" if cls is None else cls.msgname


def version(frame: bytes) -> int:
    """Return the MAVLink version, 1 or 2, of a frame yielded by ``split``."""
    return 1 if frame[0] == _MAGIC_V1 else 2


def split(datagram: bytes) -> Iterator[Frame]:
    """Yield (message id, system id, component id, frame) of each frame in ``datagram``.

    Only lengths are checked here; ``decoder`` checks the CRC.

    Raises:
        FrameError: after the valid frames before it, bytes that do not begin a frame, a truncated frame, or a frame
            with unknown incompatibility flags.
    """
    frames, end = mavlink_wire.split(datagram)
    yield from frames
    if end < len(datagram):
        raise frame_error(datagram, end)


def frame_error(datagram: bytes, start: int) -> FrameError:
    """Return the error of ``datagram``, in which no frame or an incomplete one begins at ``start``."""
    size, magic = len(datagram), datagram[start]
    if magic == _MAGIC_V2 and start + _HEADER_V2 <= size:
        flags = datagram[start + 2]
        if flags & ~_FLAG_SIGNED:
            return FrameError(f"incompatibility flags 0x{flags:02x} are unknown")
        length = datagram[start + 1] + 12 + (_SIGNATURE_LENGTH if flags & _FLAG_SIGNED else 0)
        number = datagram[start + 7] | datagram[start + 8] << 8 | datagram[start + 9] << 16
    elif magic == _MAGIC_V1 and start + _HEADER_V1 <= size:
        length, number = datagram[start + 1] + 8, datagram[start + 5]
    else:
        return FrameError(f"byte 0x{magic:02x} at {start} of {size} does not begin a MAVLink frame")
    return FrameError(f"{message_name(number)} is truncated: {size - start} of {length} bytes")


def _general_decoder() -> Decoder:
    parser = mavlink.MAVLink(None)

    def decode(frame: bytes) -> Any:
        try:
            return parser.decode(bytearray(frame))
        except mavlink.MAVError as error:
            raise FrameError(str(error)) from error

    return decode


_decode_general = _general_decoder()


@cache  # creating a named tuple class is slow, and all vehicles of a fleet use the same ones
def decoder(name: str) -> Decoder:
    """Return a function that decodes a frame of message ``name`` into an object with the message's fields.

    Raises:
        KeyError: the dialect does not define the message.
    """
    cls: Any = MESSAGES[MESSAGE_ID[name]]
    if "char" in cls.fieldtypes:
        return _decode_general
    record: Any = namedtuple(name, cls.ordered_fieldnames)  # type: ignore[misc]
    return mavlink_wire.Decoder(compiled(cls), name, record, cls.lengths, FrameError).decode
