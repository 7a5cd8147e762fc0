"""A ULog as numbered pieces for MAVLink, cut as PX4 v1.14's ``log_writer_mavlink`` cuts it."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

PIECE_SIZE = 249  # bytes, the data field of LOGGING_DATA
NO_MESSAGE = 255  # first_message_offset of a piece in which no message begins
CAPACITY = 4096  # limit of queued pieces of data, 1 MB: about 20 s of a log
_FILE_HEADER_SIZE = 16  # bytes, the header of a ULog, which is not a message
_MESSAGE_HEADER_SIZE = 3  # bytes


class Piece(NamedTuple):
    """A part of a log.

    Attributes:
        sequence: number, 0 to 65535, then 0 again.
        first_message: offset in ``data`` at which a message begins; ``NO_MESSAGE`` if none does.
        data: at most ``PIECE_SIZE`` bytes.
    """

    sequence: int
    first_message: int
    data: bytes


class LogStream:
    """The pieces of one log: definitions, which the client must receive completely, then data.

    The logger writes into it and starts the data when ``definitions`` is empty; the MAVLink side removes pieces.

    Attributes:
        definitions: pieces of the header and the definitions that remain to be acknowledged.
        data: pieces of data that remain to be sent; beyond ``CAPACITY`` the oldest are dropped.
        closed: whether the stream has ended.
    """

    def __init__(self) -> None:
        self.definitions: deque[Piece] = deque()
        self.data: deque[Piece] = deque(maxlen=CAPACITY)
        self.closed = False
        self._pieces = self.definitions
        self._partial = b""
        self._first_message = NO_MESSAGE
        self._sequence = 0
        self._has_header = False

    def write(self, data: bytes) -> None:
        """Cut ``data`` into pieces; it consists of whole messages, preceded in the first call by the file's header."""
        at, end = 0, 0 if self.closed else len(data)
        while at < end:
            size = _MESSAGE_HEADER_SIZE + int.from_bytes(data[at : at + 2], "little")
            if not self._has_header:
                size, self._has_header = _FILE_HEADER_SIZE, True
            self._add(data[at : at + size])
            at += size

    def _add(self, message: bytes) -> None:
        if self._first_message == NO_MESSAGE:
            self._first_message = len(self._partial)
        self._partial += message
        while len(self._partial) >= PIECE_SIZE:
            self._cut()

    def _cut(self) -> None:
        self._pieces.append(Piece(self._sequence, self._first_message, self._partial[:PIECE_SIZE]))
        self._partial = self._partial[PIECE_SIZE:]
        self._first_message = NO_MESSAGE
        self._sequence = self._sequence + 1 & 0xFFFF

    def flush(self) -> None:
        """Do nothing: an incomplete piece of data waits for the next messages, as in PX4."""

    def finish_definitions(self) -> None:
        """Complete the definitions; all further messages are data."""
        if self._partial:
            self._cut()
        self._pieces = self.data

    def close(self) -> None:
        """End the stream and drop all pieces."""
        self.closed = True
        self.definitions.clear()
        self.data.clear()
