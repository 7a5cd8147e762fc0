"""A node's connection to the simulator's lockstep server: over a Unix domain socket on one machine, else over TCP."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlparse

from xtdrone_native import lockstep_io

from .. import unix_sockets
from ..protocol import (
    Barrier,
    FrameReader,
    Kind,
    ProtocolError,
    pack_object,
    printable,
    same_machine,
    tune,
    unpack_object,
)
from ..transport.topic_reader import Reader

CONNECT_LIMIT = 10.0
"""Wall seconds for the simulator to answer."""
LONGEST_REASON = 500
"""Characters of the simulator's reasons that are logged."""
URI_PARAM = "/lockstep/uri"
"""ROS parameter with the address of the simulator."""


class RefusedError(Exception):
    """The server refuses the node.

    Attributes:
        code: Code of the REFUSED frame.
    """

    def __init__(self, code: str, reason: str) -> None:
        super().__init__(reason)
        self.code = code


def reason_of(content: Mapping[str, Any]) -> str:
    """Return the reason of a REFUSED or LEAVE frame as one printable line."""
    return printable(str(content.get("reason")), LONGEST_REASON)


class ServerConnection:
    """Sends and receives frames.

    Attributes:
        uri: Address of the simulator.
        remote: Whether the simulator runs on another machine.
        lock: Held while sending.
        frames: Received frames (type, payload) that have not been handled.
    """

    def __init__(self, uri: str) -> None:
        """Store the address; ``ask`` connects."""
        self.uri = uri
        self.remote = False
        self.lock = threading.Lock()
        self.frames: deque[tuple[int, bytes]] = deque()
        self._sock: socket.socket | None = None
        self._descriptor = -1  # of a watched connection
        self._frame_reader = FrameReader()

    def ask(self, kind: Kind, content: Mapping[str, Any]) -> dict[str, Any]:
        """Send RESERVE or JOIN, connecting first if necessary, and return the content of WELCOME.

        Raises:
            OSError: There is no connection.
            ProtocolError: The URI or the answer is not that of a lockstep server.
            RefusedError: The server refuses the node.
        """
        if self._sock is None:
            self._sock = self._connect()
        self._sock.settimeout(CONNECT_LIMIT)
        self._sock.sendall(pack_object(kind, content))
        while not self.frames:
            self.read()
        answer, payload = self.frames.popleft()
        if answer == Kind.REFUSED:
            refusal = unpack_object(payload)
            raise RefusedError(str(refusal.get("code")), reason_of(refusal))
        if answer != Kind.WELCOME:
            raise ProtocolError(f"the answer to {kind.name} was a frame of type {answer}")
        return unpack_object(payload)

    def watch(self, reader: Reader, handler: Callable[[], None]) -> None:
        """Register ``handler``, which ``reader`` calls whenever data can be read, except in ``await_frames``."""
        sock = self._connection()
        sock.settimeout(None)
        self._descriptor = sock.fileno()
        reader.watch(self._descriptor, handler)

    def await_frames(self, reader: Reader, timeout: float) -> Barrier | None:
        """Wait for data from the simulator or for anything else that ``reader`` handles.

        Args:
            reader: The reader given to ``watch``.
            timeout: Longest wait in wall seconds.

        Returns:
            The content of a TICK if exactly one complete TICK has arrived; otherwise None, and received frames are in
            ``frames``.

        Raises:
            OSError: The connection is closed.
            ProtocolError: The data is invalid.
        """
        return self._sort(reader.receive(self._descriptor, timeout, whole=not self._frame_reader))

    @property
    def pending(self) -> bool:
        """Whether data has been received that is not handled."""
        return bool(self.frames or self._frame_reader)

    def compiled_turns(self, reader: Reader, topics: int, tick: int, time_us: int) -> lockstep_io.Turns:
        """Return an object that runs turns over this connection; ``carry`` starts it.

        Args:
            reader: The reader given to ``watch``.
            topics: Number of topics that its program receives.
            tick: Number of the last turn.
            time_us: Simulation time of the last turn in microseconds.
        """
        lock, sock = self.lock, self._connection()
        return lockstep_io.Turns(
            reader.descriptor, self._descriptor, lock.acquire, lock.release, sock.sendall, topics, tick, time_us
        )

    def carry(
        self, reader: Reader, turns: lockstep_io.Turns, program: Any, until_us: int, timeout: float
    ) -> Barrier | None:
        """Run turns without Python, then handle the event that has ended them, like ``await_frames``.

        Args:
            reader: The reader given to ``watch``.
            turns: Object that runs the turns.
            program: Capsule of the ``TurnProgram``.
            until_us: Simulation time in microseconds from which on Python runs the turns.
            timeout: Longest wait in wall seconds.
        """
        return self._sort(reader.sort(turns.run(program, until_us, timeout)))

    def _sort(self, received: bytes | tuple[int, int, dict[int, int], dict[int, int]] | None) -> Barrier | None:
        if isinstance(received, tuple):
            return Barrier._make(received)
        if received is not None:
            self._accept(received)
        return None

    def send(self, data: bytes) -> None:
        """Send frames; the caller holds ``lock``.

        Raises:
            OSError: The connection is closed.
        """
        self._connection().sendall(data)

    def send_done(self, tick: int, time_us: int, channels: dict[int, int], datagrams: dict[int, int]) -> None:
        """Send DONE, see ``protocol.pack_barrier``; the caller holds ``lock``.

        Raises:
            OSError: The connection is closed.
        """
        rest = lockstep_io.send_done(self._descriptor, tick, time_us, channels, datagrams)
        if rest:
            self._connection().sendall(rest)

    def read(self) -> None:
        """Read the data at hand into ``frames``, waiting for at least one byte.

        Raises:
            OSError: The connection is closed.
            ProtocolError: The data is invalid.
        """
        self._accept(self._connection().recv(1 << 16))

    def _accept(self, data: bytes) -> None:
        if not data:
            raise ConnectionError("it has closed the connection")
        self._frame_reader.feed(data)
        self.frames.extend(self._frame_reader.frames())

    def read_rest(self) -> None:
        """Read the data left on a broken connection, if any."""
        with contextlib.suppress(OSError, ProtocolError):
            self._connection().settimeout(0.0)
            self.read()

    def close(self) -> None:
        """Close the connection."""
        self._descriptor = -1
        if self._sock is not None:
            self._sock.close()

    def _connect(self) -> socket.socket:
        address = urlparse(self.uri)
        if address.scheme != "tcp" or not address.hostname or not address.port:
            raise ProtocolError(f"{URI_PARAM} is {self.uri!r}, it must be tcp://host:port")
        beside = unix_sockets.connect(unix_sockets.SERVER, address.hostname, address.port, CONNECT_LIMIT)
        if beside is not None:
            return beside
        sock = socket.create_connection((address.hostname, address.port), timeout=CONNECT_LIMIT)
        tune(sock)
        self.remote = not same_machine(sock.getpeername()[0], sock.getsockname()[0])
        return sock

    def _connection(self) -> socket.socket:
        if self._sock is None:
            raise ConnectionError("not connected")
        return self._sock
