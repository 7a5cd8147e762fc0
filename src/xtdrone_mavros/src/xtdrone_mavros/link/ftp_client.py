"""Client of MAVLink FTP for blocking services.

Source: mavlink.io, "File Transfer Protocol (FTP)"; numbers, commands and errno follow MAVROS's ftp plugin. Unlike
MAVROS, a request whose answer is lost is sent again with the same number, so that the autopilot repeats its answer
without repeating the action, and concurrent calls are queued where MAVROS rejects the second.

Calls block in service threads; answers arrive in the receiver thread. Timeouts are wall time.
"""

from __future__ import annotations

import contextlib
import errno
import queue
import struct
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.codec import FrameError, decoder

LIMIT = 1.0  # s, timeout of an answer
SLOW_LIMIT = 5.0  # s, for operations that are slow on an autopilot with a memory card
RETRIES = 3
LARGEST = 239  # data bytes in a message
READ, WRITE, CREATE = 0, 1, 2  # modes of ``open``

_HEADER = struct.Struct("<HBBBBBBI")  # sequence, session, opcode, size, request opcode, -, -, offset
_SIZE = struct.Struct("<I")
_PAYLOAD = _HEADER.size + LARGEST
_HIGHEST_OFFSET = 0xFFFFFFFF

_TERMINATE, _RESET, _LIST, _OPEN_RO, _READ, _CREATE, _WRITE, _REMOVE, _MAKE_FOLDER, _REMOVE_FOLDER = range(1, 11)
_OPEN_WO, _TRUNCATE, _RENAME, _CRC32 = range(11, 15)
_OPEN = {READ: _OPEN_RO, WRITE: _OPEN_WO, CREATE: _CREATE}
_SLOW = frozenset({_LIST, _TRUNCATE, _CRC32})
_ACK, _NAK = 128, 129
_WITH_ERRNO, _EOF = 2, 6

# Protocol error to errno. The first four lines are MAVROS's; it has no entry for the others and returns 0.
_ERRNO = {
    1: errno.EFAULT, 3: errno.EMSGSIZE,
    4: errno.EBADFD, 5: errno.EMFILE,
    7: errno.ENOSYS,
    _EOF: errno.ENODATA, 8: errno.EEXIST, 9: errno.EACCES, 10: errno.ENOENT,
}  # fmt: skip

_decode = decoder("FILE_TRANSFER_PROTOCOL")


class FtpError(Exception):
    """A failed request.

    Attributes:
        number: errno of the failure.
    """

    def __init__(self, number: int) -> None:
        """Store the errno."""
        super().__init__(errno.errorcode.get(number, str(number)))
        self.number = number


class Entry(NamedTuple):
    """An entry of a directory: its name, whether it is a directory, and a file's size in bytes."""

    name: str
    is_folder: bool
    size: int


class _Answer(NamedTuple):
    sequence: int
    session: int
    kind: int
    opcode: int
    offset: int
    data: bytes

    @property
    def at_end(self) -> bool:
        """Whether the answer marks the end of the file or list."""
        return self.kind == _NAK and self.data[:1] == bytes([_EOF])

    def failure(self) -> FtpError | None:
        """Return the error of a NAK; None for an ACK."""
        if self.kind == _ACK:
            return None
        code, number = (*self.data[:2], 0, 0)[:2]
        return FtpError(number if code == _WITH_ERRNO else _ERRNO.get(code, errno.EFAULT))


class FtpClient:
    """FTP client of one autopilot; requests run one at a time."""

    def __init__(
        self,
        send: Callable[[Any], None],
        target: tuple[int, int],
        own_system: int,
        meanwhile: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        """Prepare the client.

        Args:
            send: sends a message.
            target: the autopilot's system and component id.
            own_system: system id used for requests; answers to others are ignored.
            meanwhile: returns a context manager that is held while waiting for an answer.
        """
        self._send = send
        self._target = target
        self._own_system = own_system
        self._meanwhile = meanwhile
        self._turn = threading.Lock()
        self._sequence = 0
        self._waiting = False
        self._inbox: queue.SimpleQueue[_Answer] = queue.SimpleQueue()
        self._sessions: dict[str, int] = {}

    def on_answer(self, frame: bytes) -> None:
        """Queue a FILE_TRANSFER_PROTOCOL frame; called by the receiver thread."""
        if not self._waiting:
            return
        try:
            m = _decode(frame)
        except FrameError:
            return  # a damaged answer counts as lost
        if m.target_system == self._own_system:
            payload = bytes(m.payload)
            sequence, session, kind, size, opcode, _, _, offset = _HEADER.unpack_from(payload)
            data = payload[_HEADER.size : _HEADER.size + size]
            self._inbox.put(_Answer(sequence, session, kind, opcode, offset, data))

    def forget(self) -> None:
        """Drop all sessions, after the autopilot was rebooted or replaced."""
        self._sessions.clear()

    # Operations of the services; each raises FtpError on failure.

    def list(self, path: str) -> list[Entry]:
        """Return the entries of a directory."""
        entries: list[Entry] = []
        with self._turn:
            offset = 0
            while True:
                answer = self._ask(_LIST, data=_path(path), offset=offset)
                if answer.at_end:
                    return entries
                records = _records(_require_ack(answer).data)
                if not records:
                    return entries
                offset += len(records)
                entries += [entry for record in records if (entry := _entry(record)) is not None]

    def open(self, path: str, mode: int) -> int:
        """Open a file with mode ``READ``, ``WRITE`` or ``CREATE``; return its size in bytes."""
        if mode not in _OPEN:
            raise FtpError(errno.EINVAL)
        with self._turn:
            if path in self._sessions:
                raise FtpError(errno.EBUSY)
            answer = _require_ack(self._ask(_OPEN[mode], data=_path(path)))
            self._sessions[path] = answer.session
            return _number(answer.data) if len(answer.data) >= _SIZE.size else 0

    def close(self, path: str) -> None:
        """Close a file."""
        with self._turn:
            session = self._session(path)
            del self._sessions[path]
            _require_ack(self._ask(_TERMINATE, session))

    def read(self, path: str, offset: int, size: int) -> bytes:
        """Read up to ``size`` bytes of an open file from ``offset``; fewer at its end."""
        with self._turn:
            session = self._session(path)
            data = bytearray()
            while True:
                answer = self._ask(_READ, session, offset + len(data))
                if answer.at_end:
                    return bytes(data)
                part = _require_ack(answer).data
                data += part[: size - len(data)]
                if len(part) < LARGEST or len(data) >= size:
                    return bytes(data)

    def write(self, path: str, offset: int, data: bytes) -> None:
        """Write to an open file at ``offset``."""
        with self._turn:
            session = self._session(path)
            done = 0
            while True:
                part = data[done : done + LARGEST]
                written = _number(_require_ack(self._ask(_WRITE, session, offset + done, part)).data)
                if part and not 0 < written <= len(part):
                    raise FtpError(errno.EIO)
                done += written
                if done >= len(data):
                    return

    def remove(self, path: str) -> None:
        """Remove a file."""
        self._do(_REMOVE, _path(path))

    def make_folder(self, path: str) -> None:
        """Create a directory."""
        self._do(_MAKE_FOLDER, _path(path))

    def remove_folder(self, path: str) -> None:
        """Remove an empty directory."""
        self._do(_REMOVE_FOLDER, _path(path))

    def rename(self, old: str, new: str) -> None:
        """Rename a file or directory."""
        both = _path(old) + b"\0" + _path(new)
        if len(both) >= LARGEST:
            raise FtpError(errno.ENAMETOOLONG)
        self._do(_RENAME, both)

    def truncate(self, path: str, length: int) -> None:
        """Truncate a file to ``length`` bytes."""
        self._do(_TRUNCATE, _path(path), length)

    def checksum(self, path: str) -> int:
        """Return the CRC-32 of a file as computed by PX4."""
        return _number(self._do(_CRC32, _path(path)).data)

    def reset(self) -> None:
        """Close all files on both sides."""
        self._sessions.clear()
        self._do(_RESET)

    # Protocol

    def _session(self, path: str) -> int:
        if path not in self._sessions:
            raise FtpError(errno.EBADF)
        return self._sessions[path]

    def _do(self, opcode: int, data: bytes = b"", offset: int = 0) -> _Answer:
        with self._turn:
            return _require_ack(self._ask(opcode, data=data, offset=offset))

    def _ask(self, opcode: int, session: int = 0, offset: int = 0, data: bytes = b"") -> _Answer:
        """Send a request, with retries, and return its answer; the caller holds the lock."""
        if offset > _HIGHEST_OFFSET:
            raise FtpError(errno.EFBIG)
        limit = SLOW_LIMIT if opcode in _SLOW else LIMIT
        while not self._inbox.empty():
            self._inbox.get()
        self._waiting = True
        try:
            for _ in range(1 + RETRIES):
                head = _HEADER.pack(self._sequence, session, opcode, len(data), 0, 0, 0, offset)
                payload = list((head + data).ljust(_PAYLOAD, b"\0"))
                self._send(mavlink.MAVLink_file_transfer_protocol_message(0, *self._target, payload))
                answer = self._wait(limit)
                if answer is not None and (answer.opcode, answer.offset) == (opcode, offset):
                    return answer
                if answer is not None:
                    # An answer to an earlier client's request with this number; PX4 repeats its last answer.
                    self._sequence = (self._sequence + 1) & 0xFFFF
            self._sequence = (self._sequence + 1) & 0xFFFF  # late answers must not match a later request
            raise FtpError(errno.ETIMEDOUT)
        finally:
            self._waiting = False

    def _wait(self, limit: float) -> _Answer | None:
        """Wait for the answer, whose number is one above the request's and equals that of the next request."""
        expected = (self._sequence + 1) & 0xFFFF
        end = time.monotonic() + limit
        with self._meanwhile():
            while True:
                try:
                    answer = self._inbox.get(timeout=max(end - time.monotonic(), 0.0))
                except queue.Empty:
                    return None
                if answer.sequence == expected and answer.kind in (_ACK, _NAK):
                    self._sequence = expected
                    return answer


def _require_ack(answer: _Answer) -> _Answer:
    if (failure := answer.failure()) is not None:
        raise failure
    return answer


def _number(data: bytes) -> int:
    if len(data) < _SIZE.size:
        raise FtpError(errno.EBADMSG)
    return int(_SIZE.unpack_from(data)[0])


def _path(path: str) -> bytes:
    data = path.encode()
    if b"\0" in data:
        raise FtpError(errno.EINVAL)
    if len(data) >= LARGEST:  # MAVROS truncates it
        raise FtpError(errno.ENAMETOOLONG)
    return data


def _records(data: bytes) -> list[bytes]:
    """Return the zero-terminated entries in the answer to a list request."""
    if not data:
        return []
    if data[-1] != 0:
        raise FtpError(errno.EOVERFLOW)
    return data[:-1].split(b"\0")


def _entry(record: bytes) -> Entry | None:
    """Parse a directory entry; return None for an entry to skip."""
    kind, text = record[:1], record[1:].decode("utf-8", "replace")
    if kind == b"D" and text:
        return Entry(text, True, 0)
    if kind != b"F" or not text:
        return None
    name, _, size = text.partition("\t")
    return Entry(name, False, int(size) if size.isascii() and size.isdecimal() else 0)
