"""Files of the autopilot over MAVLink FTP, for services that wait.

Source: mavlink.io, "File Transfer Protocol (FTP)"; numbers, commands and errno as MAVROS's ftp plugin has them. Unlike
MAVROS a request whose answer is lost is sent again, with the same number, so that the autopilot answers it again
without doing it twice; and calls at the same time take turns, where MAVROS refuses the second.

Calls come from service threads and wait there; answers come from the receiver thread. Time-outs are wall time.
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

from xtdrone_control.mavlink.wire.codec import FrameError, decoder

LIMIT = 1.0  # s for an answer
SLOW_LIMIT = 5.0  # s, for what takes an autopilot with a memory card long
RETRIES = 3
LARGEST = 239  # bytes of data in a message
READ, WRITE, CREATE = 0, 1, 2  # how a file is opened

_HEADER = struct.Struct("<HBBBBBBI")  # number, session, opcode, size, asked opcode, -, -, offset
_SIZE = struct.Struct("<I")
_PAYLOAD = _HEADER.size + LARGEST
_HIGHEST_OFFSET = 0xFFFFFFFF

_TERMINATE, _RESET, _LIST, _OPEN_RO, _READ, _CREATE, _WRITE, _REMOVE, _MAKE_FOLDER, _REMOVE_FOLDER = range(1, 11)
_OPEN_WO, _TRUNCATE, _RENAME, _CRC32 = range(11, 15)
_OPEN = {READ: _OPEN_RO, WRITE: _OPEN_WO, CREATE: _CREATE}
_SLOW = frozenset({_LIST, _TRUNCATE, _CRC32})
_ACK, _NAK = 128, 129
_WITH_ERRNO, _EOF = 2, 6

# Error of the protocol to errno. The first four lines are MAVROS's; it has none for the others and answers 0.
_ERRNO = {
    1: errno.EFAULT, 3: errno.EMSGSIZE,
    4: errno.EBADFD, 5: errno.EMFILE,
    7: errno.ENOSYS,
    _EOF: errno.ENODATA, 8: errno.EEXIST, 9: errno.EACCES, 10: errno.ENOENT,
}  # fmt: skip

_decode = decoder("FILE_TRANSFER_PROTOCOL")


class FtpError(Exception):
    """A request that has failed.

    Attributes:
        number: errno that says why.
    """

    def __init__(self, number: int) -> None:
        """Take the errno."""
        super().__init__(errno.errorcode.get(number, str(number)))
        self.number = number


class Entry(NamedTuple):
    """What lies in a folder: its name, whether it is a folder itself, and a file's size in bytes."""

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
        """Whether it says that there is nothing more."""
        return self.kind == _NAK and self.data[:1] == bytes([_EOF])

    def failure(self) -> FtpError | None:
        """Return what a refusal says; None for an acknowledgement."""
        if self.kind == _ACK:
            return None
        code, number = (*self.data[:2], 0, 0)[:2]
        return FtpError(number if code == _WITH_ERRNO else _ERRNO.get(code, errno.EFAULT))


class FtpClient:
    """The requests to one autopilot; they take turns."""

    def __init__(
        self,
        send: Callable[[Any], None],
        target: tuple[int, int],
        own_system: int,
        meanwhile: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        """Prepare.

        Args:
            send: sends a message.
            target: the autopilot's system and component id.
            own_system: the system id that requests are sent as; answers to others are ignored.
            meanwhile: returns what is to be entered while an answer is waited for.
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
        """Take a FILE_TRANSFER_PROTOCOL frame; for the receiver thread."""
        if not self._waiting:
            return
        try:
            m = _decode(frame)
        except FrameError:
            return  # a damaged answer is a lost one
        if m.target_system == self._own_system:
            payload = bytes(m.payload)
            sequence, session, kind, size, opcode, _, _, offset = _HEADER.unpack_from(payload)
            data = payload[_HEADER.size : _HEADER.size + size]
            self._inbox.put(_Answer(sequence, session, kind, opcode, offset, data))

    def forget(self) -> None:
        """Forget the open files: the autopilot has been rebooted, or is another one."""
        self._sessions.clear()

    # What the services do; each raises FtpError when it fails.

    def list(self, path: str) -> list[Entry]:
        """Return what a folder holds."""
        entries: list[Entry] = []
        with self._turn:
            offset = 0
            while True:
                answer = self._ask(_LIST, data=_path(path), offset=offset)
                if answer.at_end:
                    return entries
                records = _records(_accepted(answer).data)
                if not records:
                    return entries
                offset += len(records)
                entries += [entry for record in records if (entry := _entry(record)) is not None]

    def open(self, path: str, mode: int) -> int:
        """Open a file, to read (``READ``), to ``WRITE``, or to ``CREATE`` it; return its size in bytes."""
        if mode not in _OPEN:
            raise FtpError(errno.EINVAL)
        with self._turn:
            if path in self._sessions:
                raise FtpError(errno.EBUSY)
            answer = _accepted(self._ask(_OPEN[mode], data=_path(path)))
            self._sessions[path] = answer.session
            return _number(answer.data) if len(answer.data) >= _SIZE.size else 0

    def close(self, path: str) -> None:
        """Close a file."""
        with self._turn:
            session = self._session(path)
            del self._sessions[path]
            _accepted(self._ask(_TERMINATE, session))

    def read(self, path: str, offset: int, size: int) -> bytes:
        """Return up to ``size`` bytes of an open file from ``offset`` on; fewer at its end."""
        with self._turn:
            session = self._session(path)
            data = bytearray()
            while True:
                answer = self._ask(_READ, session, offset + len(data))
                if answer.at_end:
                    return bytes(data)
                part = _accepted(answer).data
                data += part[: size - len(data)]
                if len(part) < LARGEST or len(data) >= size:
                    return bytes(data)

    def write(self, path: str, offset: int, data: bytes) -> None:
        """Write into an open file from ``offset`` on."""
        with self._turn:
            session = self._session(path)
            done = 0
            while True:
                part = data[done : done + LARGEST]
                written = _number(_accepted(self._ask(_WRITE, session, offset + done, part)).data)
                if part and not 0 < written <= len(part):
                    raise FtpError(errno.EIO)
                done += written
                if done >= len(data):
                    return

    def remove(self, path: str) -> None:
        """Remove a file."""
        self._do(_REMOVE, _path(path))

    def make_folder(self, path: str) -> None:
        """Make a folder."""
        self._do(_MAKE_FOLDER, _path(path))

    def remove_folder(self, path: str) -> None:
        """Remove an empty folder."""
        self._do(_REMOVE_FOLDER, _path(path))

    def rename(self, old: str, new: str) -> None:
        """Rename a file or folder."""
        both = _path(old) + b"\0" + _path(new)
        if len(both) >= LARGEST:
            raise FtpError(errno.ENAMETOOLONG)
        self._do(_RENAME, both)

    def truncate(self, path: str, length: int) -> None:
        """Cut a file to ``length`` bytes."""
        self._do(_TRUNCATE, _path(path), length)

    def checksum(self, path: str) -> int:
        """Return the CRC-32 of a file, as PX4 computes it."""
        return _number(self._do(_CRC32, _path(path)).data)

    def reset(self) -> None:
        """Close all files, on both sides."""
        self._sessions.clear()
        self._do(_RESET)

    # The protocol

    def _session(self, path: str) -> int:
        if path not in self._sessions:
            raise FtpError(errno.EBADF)
        return self._sessions[path]

    def _do(self, opcode: int, data: bytes = b"", offset: int = 0) -> _Answer:
        with self._turn:
            return _accepted(self._ask(opcode, data=data, offset=offset))

    def _ask(self, opcode: int, session: int = 0, offset: int = 0, data: bytes = b"") -> _Answer:
        """Send a request, a few times, and return the answer to it; the caller has the turn."""
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
                    # It answers what a client before this one has asked by the same number. PX4 keeps the last answer.
                    self._sequence = (self._sequence + 1) & 0xFFFF
            self._sequence = (self._sequence + 1) & 0xFFFF  # what still comes answers nothing that is asked later
            raise FtpError(errno.ETIMEDOUT)
        finally:
            self._waiting = False

    def _wait(self, limit: float) -> _Answer | None:
        """Wait for the answer that has the number after the request's, which is the number of the next request."""
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


def _accepted(answer: _Answer) -> _Answer:
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
    if len(data) >= LARGEST:  # MAVROS cuts it off
        raise FtpError(errno.ENAMETOOLONG)
    return data


def _records(data: bytes) -> list[bytes]:
    """Return the entries of a list's answer, each of which ends with a zero byte."""
    if not data:
        return []
    if data[-1] != 0:
        raise FtpError(errno.EOVERFLOW)
    return data[:-1].split(b"\0")


def _entry(record: bytes) -> Entry | None:
    """Return an entry; None for one that is to be skipped."""
    kind, text = record[:1], record[1:].decode("utf-8", "replace")
    if kind == b"D" and text:
        return Entry(text, True, 0)
    if kind != b"F" or not text:
        return None
    name, _, size = text.partition("\t")
    return Entry(name, False, int(size) if size.isascii() and size.isdecimal() else 0)
