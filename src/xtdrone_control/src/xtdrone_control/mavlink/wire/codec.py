"""MAVLink frames: splitting of datagrams and decoding of frames with pymavlink's tables.

For LOCAL_POSITION_NED, pymavlink's ``MAVLink.decode`` costs 3.1 us and ``parse_char`` 4.4 us; its unpacker and CRC
function, applied to an exact frame, cost 0.5 us. Messages are therefore decoded with the latter, into a named tuple
with MAVLink's field names. Messages with text are rare and use ``MAVLink.decode``.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.mavlink.wire.dialect import MESSAGE_ID, MESSAGES

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


def split(datagram: bytes) -> Iterator[tuple[int, int, int, bytes]]:
    """Yield (message id, system id, component id, frame) of each frame in ``datagram``.

    Only lengths are checked here; ``decoder`` checks the CRC.

    Raises:
        FrameError: bytes that begin no frame, a truncated frame, or a frame with unknown incompatibility flags, after
            the frames before it have been yielded.
    """
    start, size = 0, len(datagram)
    while start < size:
        magic = datagram[start]
        if magic == _MAGIC_V2 and start + _HEADER_V2 <= size:
            flags = datagram[start + 2]
            end = start + datagram[start + 1] + 12 + (_SIGNATURE_LENGTH if flags & _FLAG_SIGNED else 0)
            if flags & ~_FLAG_SIGNED:
                raise FrameError(f"incompatibility flags 0x{flags:02x} are unknown")
            number = datagram[start + 7] | datagram[start + 8] << 8 | datagram[start + 9] << 16
            system, component = datagram[start + 5], datagram[start + 6]
        elif magic == _MAGIC_V1 and start + _HEADER_V1 <= size:
            end = start + datagram[start + 1] + 8
            number, system, component = datagram[start + 5], datagram[start + 3], datagram[start + 4]
        else:
            raise FrameError(f"byte 0x{magic:02x} at {start} of {size} begins no MAVLink frame")
        if end > size:
            raise FrameError(f"{message_name(number)} is truncated: {size - start} of {end - start} bytes")
        yield number, system, component, datagram[start:end]
        start = end


def _general_decoder() -> Decoder:
    parser = mavlink.MAVLink(None)

    def decode(frame: bytes) -> Any:
        try:
            return parser.decode(bytearray(frame))
        except mavlink.MAVError as error:
            raise FrameError(str(error)) from error

    return decode


_decode_general = _general_decoder()


def _record_maker(cls: Any) -> Callable[[tuple[Any, ...]], Any]:
    """Return a function from the unpacked payload (wire order, arrays flattened) to the message's named tuple."""
    record: Any = namedtuple(cls.msgname, cls.ordered_fieldnames)  # type: ignore[misc]
    make = record._make
    lengths = cls.lengths
    scalars = len(lengths) if max(lengths) == 1 else next(i for i, length in enumerate(lengths) if length > 1)
    if scalars == len(lengths):
        return make
    if scalars == len(lengths) - 1:  # one array at the end, as in ATTITUDE_QUATERNION
        return lambda values: make((*values[:scalars], values[scalars:]))
    starts = [sum(lengths[:i]) for i in range(len(lengths))]
    layout = [(start, start + length, length == 1) for start, length in zip(starts, lengths, strict=True)]
    return lambda values: make(values[i] if single else values[i:j] for i, j, single in layout)


@cache  # creating a named tuple class is slow, and all vehicles of a fleet use the same ones
def decoder(name: str) -> Decoder:
    """Return a function that decodes a frame of message ``name`` into an object with the message's fields.

    Raises:
        KeyError: the dialect does not define the message.
    """
    cls: Any = MESSAGES[MESSAGE_ID[name]]
    if "char" in cls.fieldtypes:
        return _decode_general
    make = _record_maker(cls)
    unpack, size, crc_extra = cls.unpacker.unpack, cls.unpacker.size, bytes([cls.crc_extra])
    crc = mavlink.mcrf4xx or (lambda buffer: mavlink.x25crc(buffer).crc)

    def decode(frame: bytes) -> Any:
        start = _HEADER_V2 if frame[0] == _MAGIC_V2 else _HEADER_V1
        end = start + frame[1]
        if crc(frame[1:end] + crc_extra) != frame[end] | frame[end + 1] << 8:
            raise FrameError(f"{name}: CRC is wrong")
        payload = frame[start:end]
        # MAVLink 2 truncates trailing zeros, MAVLink 1 has no extension fields, a newer dialect more of them
        if len(payload) != size:
            payload = payload[:size].ljust(size, b"\0")
        return make(unpack(payload))

    return decode
