"""MAVLink FTP, read-only: the vehicle's logs and the files of other services, at PX4's paths.

Sources: mavlink.io, "File Transfer Protocol (FTP)"; sessions and replies follow PX4's mavlink_ftp. Each client has one
session, number 0; a repeated request (its reply was lost) gets the same reply again.

The tree is virtual: ``/fs/microsd/log/<date>/<time>.ulg``, as on a flight controller, ``/log/...``, as in PX4's SITL,
and the files of ``Vehicle.files``. Paths are resolved in this tree and never passed to the operating system, so no path
leads out of it.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from io import BytesIO
from typing import Any, BinaryIO, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.logger.log_folder import LogEntry, LogFolder
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.service_base import NEVER_US, Service, Vehicle
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_autopilot.mavlink.wire.frame_packing import Format
from xtdrone_autopilot.parameters import metadata

_HEADER = struct.Struct("<HBBBBBBI")  # sequence, session, opcode, size, requested opcode, burst complete, -, offset
_LARGEST = 239  # bytes of data in a message
_PAYLOAD = _HEADER.size + _LARGEST

_NONE, _TERMINATE, _RESET, _LIST, _OPEN_RO, _READ, _CREATE, _WRITE, _REMOVE, _MAKE_FOLDER = range(10)
_REMOVE_FOLDER, _OPEN_WO, _TRUNCATE, _RENAME, _CRC32, _BURST_READ = range(10, 16)
_ACK, _NAK = 128, 129
_INVALID_SIZE, _INVALID_SESSION, _NO_SESSION, _EOF, _UNKNOWN, _PROTECTED, _NOT_FOUND = 3, 4, 5, 6, 7, 9, 10

BURST = 24  # messages in a period of a burst: 574 kB of a file in a simulated second
PERIOD_US = 10_000
_CRC_FLIP = 0xFFFFFFFF
_CRC_BLOCK = 1 << 20

Folder = dict[str, Any]  # name to _File or Folder


@dataclass(frozen=True)
class _File:
    """A file of the tree: its size in bytes, and a function that opens it for reading."""

    size: int
    open: Callable[[], BinaryIO]


class _RefusedError(Exception):
    """A request rejected by NAK with error ``code``."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(frozen=True)
class _Request:
    sequence: int
    session: int
    opcode: int
    size: int
    offset: int
    data: bytes

    @property
    def path(self) -> str:
        """Path in the data, up to the first zero byte."""
        return self.data[: self.size].split(b"\0", 1)[0].decode("utf-8", "replace")


@dataclass
class _Client:
    """A client's session.

    Attributes:
        file: the open file, None without a session.
        size: size of the file when it was opened; a log still being written may have grown since.
        last: the last request and its reply.
        burst: file offset of the next message of a burst, -1 for none.
        burst_size: bytes in each of its messages.
        sequence: sequence number of its next message.
        sender: system and component id that burst messages are sent to.
    """

    file: BinaryIO | None = None
    size: int = 0
    last: tuple[bytes, bytes] | None = None
    burst: int = -1
    burst_size: int = _LARGEST
    sequence: int = 0
    sender: tuple[int, int] = field(default=(0, 0))

    def close(self) -> None:
        if self.file is not None:
            self.file.close()
        self.file = None
        self.burst = -1


class FtpService(Service):
    """Serves listings and contents of the vehicle's logs and of the files of other services."""

    MESSAGES: ClassVar[dict[str, str]] = {"FILE_TRANSFER_PROTOCOL": "_request"}
    CAPABILITIES = mavlink.MAV_PROTOCOL_CAPABILITY_FTP

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._clients: dict[Link, _Client] = {}
        self._actions: dict[int, Callable[[_Client, _Request], bytes]] = {
            _NONE: lambda _client, _request: b"",
            _TERMINATE: self._terminate,
            _RESET: self._reset,
            _LIST: self._list,
            _OPEN_RO: self._open,
            _READ: self._read,
            _CRC32: self._crc32,
        }
        for opcode in (
            _CREATE, _WRITE, _REMOVE, _MAKE_FOLDER, _REMOVE_FOLDER, _OPEN_WO, _TRUNCATE, _RENAME
        ):  # fmt: skip
            self._actions[opcode] = self._refuse_writing

    @property
    def _folder(self) -> LogFolder | None:
        logs = self.vehicle.autopilot.logs
        return logs[self.vehicle.index] if logs else None

    # requests and replies

    def _request(self, link: Link, m: Any) -> None:
        payload = bytes(m.payload).ljust(_PAYLOAD, b"\0")
        sequence, session, opcode, size, _, _, _, offset = _HEADER.unpack_from(payload)
        client = self._clients.get(link)
        if client is None:
            self._drop_closed()
            client = self._clients[link] = _Client()
        if client.last is not None and client.last[0] == payload:
            self._send(link, link.sender, client.last[1])
            return
        request = _Request(sequence, session, opcode, size, offset, payload[_HEADER.size : _PAYLOAD])
        client.last = None
        try:
            if size > _LARGEST:
                raise _RefusedError(_INVALID_SIZE)
            if opcode == _BURST_READ:
                self._start_burst(client, request, link)
                return
            if opcode not in self._actions:
                raise _RefusedError(_UNKNOWN)
            reply = _reply(request, _ACK, self._actions[opcode](client, request))
        except _RefusedError as refused:
            reply = _reply(request, _NAK, bytes([refused.code]))
        client.last = (payload, reply)
        self._send(link, link.sender, reply)

    def _send(self, link: Link, receiver: tuple[int, int], payload: bytes) -> None:
        link.send_message(mavlink.MAVLink_file_transfer_protocol_message(0, *receiver, list(payload)))

    def _drop_closed(self) -> None:
        for link in [link for link in self._clients if not link.open]:
            self._clients.pop(link).close()

    # the tree

    def _tree(self) -> Folder:
        logs: Folder = {}
        for entry in [] if self._folder is None else self._folder.entries():
            logs.setdefault(entry.path.parent.name, {})[entry.path.name] = _log_file(entry)
        tree: Folder = {"fs": {"microsd": {"log": logs}}, "log": logs}
        for path, read in self.vehicle.files.items():
            *folders, name = path.strip("/").split("/")
            here = tree
            for folder in folders:
                here = here.setdefault(folder, {})
            content = read()
            here[name] = _File(len(content), partial(BytesIO, content))
        return tree

    def _find(self, path: str) -> _File | Folder:
        """Return the file or folder at ``path``.

        Raises:
            _RefusedError: the path does not exist.
        """
        here: _File | Folder = self._tree()
        for part in path.split("/"):
            if part in ("", "."):
                continue
            if not isinstance(here, dict) or part not in here:
                raise _RefusedError(_NOT_FOUND)
            here = here[part]
        return here

    def _file_at(self, path: str) -> _File:
        found = self._find(path)
        if isinstance(found, dict):
            raise _RefusedError(_NOT_FOUND)
        return found

    def _list(self, _client: _Client, request: _Request) -> bytes:
        """Return the entries of a folder from number ``offset`` on, as many as fit into a message."""
        found = self._find(request.path)
        if not isinstance(found, dict):
            raise _RefusedError(_NOT_FOUND)
        entries = [
            f"D{name}\0" if isinstance(entry, dict) else f"F{name}\t{entry.size}\0"
            for name, entry in sorted(found.items())
        ][request.offset :]
        if not entries:
            raise _RefusedError(_EOF)
        data = b""
        for entry in entries:
            if len(data) + len(entry) > _LARGEST:
                break
            data += entry.encode()
        return data

    # files

    def _open(self, client: _Client, request: _Request) -> bytes:
        if client.file is not None:
            raise _RefusedError(_NO_SESSION)
        entry = self._file_at(request.path)
        try:
            client.file = entry.open()
        except OSError as error:
            raise _RefusedError(_NOT_FOUND) from error
        client.size = min(entry.size, 0xFFFFFFFF)
        return struct.pack("<I", client.size)

    def _file(self, client: _Client, request: _Request) -> BinaryIO:
        if client.file is None or request.session != 0:
            raise _RefusedError(_INVALID_SESSION)
        return client.file

    def _read(self, client: _Client, request: _Request) -> bytes:
        file = self._file(client, request)
        if request.offset >= client.size:
            raise _RefusedError(_EOF)
        return _part(client, file, request.offset, request.size or _LARGEST)

    def _terminate(self, client: _Client, request: _Request) -> bytes:
        self._file(client, request)
        client.close()
        return b""

    def _reset(self, client: _Client, _request: _Request) -> bytes:
        client.close()
        return b""

    def _crc32(self, _client: _Client, request: _Request) -> bytes:
        """Return PX4's CRC32 of a file: it starts from 0 and does not invert; zlib inverts before and after."""
        crc = 0
        try:
            with self._file_at(request.path).open() as file:
                while block := file.read(_CRC_BLOCK):
                    crc = zlib.crc32(block, crc ^ _CRC_FLIP) ^ _CRC_FLIP
        except OSError as error:
            raise _RefusedError(_NOT_FOUND) from error
        return struct.pack("<I", crc)

    def _refuse_writing(self, _client: _Client, _request: _Request) -> bytes:
        raise _RefusedError(_PROTECTED)

    # bursts

    def _start_burst(self, client: _Client, request: _Request, link: Link) -> None:
        self._file(client, request)
        client.burst, client.burst_size = request.offset, request.size or _LARGEST
        client.sequence = request.sequence + 1
        client.sender = link.sender
        if self.due_us == NEVER_US:
            self.due_us = self.vehicle.now_us

    def update(self, now_us: int) -> None:
        """Send the next messages of all bursts."""
        self._drop_closed()
        for link in self.waiting:
            self.send_part(link, now_us)
        self.due_us = (now_us // PERIOD_US + 1) * PERIOD_US if self.waiting else NEVER_US

    @property
    def waiting(self) -> list[Link]:
        """Links to which a burst is being sent."""
        return [link for link, client in self._clients.items() if client.burst >= 0]

    def send_part(self, link: Link, _now_us: int) -> None:
        """Queue the next messages of a burst."""
        client = self._clients[link]
        assert client.file is not None
        for _ in range(BURST):
            data = _part(client, client.file, client.burst, client.burst_size)
            kind, content = (_ACK, data) if data else (_NAK, bytes([_EOF]))
            head = _HEADER.pack(client.sequence & 0xFFFF, 0, kind, len(content), _BURST_READ, 0, 0, client.burst)
            self._send(link, client.sender, (head + content).ljust(_PAYLOAD, b"\0"))
            client.sequence += 1
            client.burst += len(data)
            if not data:
                client.burst = -1
                return


def _log_file(entry: LogEntry) -> _File:
    return _File(entry.size, lambda: entry.path.open("rb"))


def _part(client: _Client, file: BinaryIO, offset: int, size: int) -> bytes:
    """Return up to ``size`` bytes of the session's file from ``offset``; empty at its end."""
    wanted = min(size, client.size - offset)
    if wanted <= 0:
        return b""
    file.seek(offset)
    return file.read(wanted)


def _reply(request: _Request, kind: int, data: bytes) -> bytes:
    head = _HEADER.pack(request.sequence + 1 & 0xFFFF, 0, kind, len(data), request.opcode, 0, 0, request.offset)
    return (head + data).ljust(_PAYLOAD, b"\0")


_METADATA, _INFORMATION = Format("COMPONENT_METADATA"), Format("COMPONENT_INFORMATION")
_FOLDER = "/etc/extras"
_GENERAL = f"{_FOLDER}/component_general.json"
_PARAMETERS = f"{_FOLDER}/parameters.json"
_EVENTS = f"{_FOLDER}/all_events.json"
_FLIP = 0xFFFFFFFF


def checksum(data: bytes) -> int:
    """Return MAVLink's CRC32: it starts from 0 and does not invert; zlib inverts before and after."""
    return zlib.crc32(data, _FLIP) ^ _FLIP


class MetadataService(Service):
    """Serves the metadata files and sends their URI."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        vehicle.files.update(
            {
                _GENERAL: lambda: self._general,
                _PARAMETERS: lambda: self._parameters,
                _EVENTS: metadata.event_definitions,
            }
        )
        vehicle.on_request.update(
            {
                MESSAGE_ID["COMPONENT_METADATA"]: self._component_metadata,
                MESSAGE_ID["COMPONENT_INFORMATION"]: self._component_information,
            }
        )

    @cached_property
    def _parameters(self) -> bytes:
        return metadata.parameter_definitions(self.vehicle.commander.parameters)

    @cached_property
    def _general(self) -> bytes:
        files = {
            metadata.PARAMETER: (_PARAMETERS, self._parameters),
            metadata.EVENTS: (_EVENTS, metadata.event_definitions()),
        }
        return metadata.general({kind: (f"mftp://{path}", checksum(data)) for kind, (path, data) in files.items()})

    def _component_metadata(self, link: Link) -> None:
        values = (self.vehicle.now_us // 1000, checksum(self._general), f"mftp://{_GENERAL}".encode())
        link.send_values(_METADATA, values, self.vehicle.now_us)

    def _component_information(self, link: Link) -> None:
        values = (self.vehicle.now_us // 1000, checksum(self._general), 0, f"mftp://{_GENERAL}".encode(), b"")
        link.send_values(_INFORMATION, values, self.vehicle.now_us)
