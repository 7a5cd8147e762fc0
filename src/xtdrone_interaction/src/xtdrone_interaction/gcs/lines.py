"""Lines to vehicles: bytes in, bytes out; nothing here blocks once a line is open."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Protocol

from .peers import ANY, GcsError

_RECEIVE_BUFFER = 1 << 20  # whoever speaks to a vehicle hears its telemetry, too
_LARGEST_DATAGRAM = 65535
_CONNECT_LIMIT = 5.0  # s for a TCP connection
_MOST_DATAGRAMS = 4096  # read at a time, so that a flood holds nobody up
_MAGIC = {0xFD: (10, 12), 0xFE: (6, 8)}  # a frame's first byte: what its header has, what it has besides its payload
_SIGNED, _SIGNATURE = 0x01, 13


class Line(Protocol):
    """What carries frames.

    Attributes:
        where: for messages.
        unreachable: whether what was sent last found nobody.
    """

    where: str
    unreachable: bool

    def fileno(self) -> int:
        """Return the descriptor that is readable when something has come."""

    def receive(self) -> list[bytes]:
        """Return what has come: whole frames, one or several in each.

        Raises:
            GcsError: the line has ended.
        """

    def send(self, data: bytes, system: int) -> None:
        """Send a frame to a system.

        Raises:
            GcsError: that cannot be.
        """

    def close(self) -> None:
        """Close it."""


def open_line(scheme: str, host: str, port: int) -> Line:
    """Open a line.

    Raises:
        GcsError: it cannot be opened.
    """
    try:
        return _KINDS[scheme](host, port)
    except OSError as error:
        where = f"{'TCP' if scheme == 'tcp' else 'UDP'} {host}:{port}"
        reason = error.strerror or str(error)
        raise GcsError(f"{where} cannot be {'bound' if scheme == 'udpin' else 'reached'}: {reason}") from error


def _udp_socket() -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    sock.setblocking(False)
    return sock


class UdpOut:
    """We speak first, to one port; see ``Line``."""

    def __init__(self, host: str, port: int) -> None:
        """Open it.

        Raises:
            OSError: there is no way to the host.
        """
        self.where = f"UDP {host}:{port}"
        self.unreachable = False
        self._socket = _udp_socket()
        try:
            self._socket.connect((host, port))
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Return the datagrams that have come."""
        found: list[bytes] = []
        while len(found) < _MOST_DATAGRAMS:
            try:
                found.append(self._socket.recv(_LARGEST_DATAGRAM))
            except ConnectionRefusedError:
                self.unreachable = True
            except OSError:
                break
        if found:
            self.unreachable = False
        return found

    def send(self, data: bytes, _system: int) -> None:
        """Send a datagram.

        Raises:
            GcsError: there is no way to the host.
        """
        try:
            self._socket.send(data)
        except ConnectionRefusedError:  # an earlier datagram found nobody
            self.unreachable = True
        except BlockingIOError:  # lost, as on the way
            pass
        except OSError as error:
            raise GcsError(f"{self.where} cannot be reached: {error.strerror}") from error

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class UdpIn:
    """Vehicles speak first, to our port; see ``Line``."""

    def __init__(self, host: str, port: int) -> None:
        """Bind the port.

        Raises:
            OSError: it is taken, or there is no such address here.
        """
        self.where = f"UDP port {host}:{port}"
        self.unreachable = False
        self._ways: dict[int, tuple[str, int]] = {}
        self._socket = _udp_socket()
        try:
            self._socket.bind((host, port))
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Return the datagrams that have come."""
        found: list[bytes] = []
        while len(found) < _MOST_DATAGRAMS:
            try:
                datagram, sender = self._socket.recvfrom(_LARGEST_DATAGRAM)
            except ConnectionRefusedError:
                continue
            except OSError:
                break
            system = _system_of(datagram)
            if system:
                self._ways[system] = sender
            found.append(datagram)
        return found

    def send(self, data: bytes, system: int) -> None:
        """Send a datagram where that system has spoken from; nowhere while it has not, everywhere for ``ANY``."""
        ways = set(self._ways.values()) if system == ANY else {self._ways[system]} if system in self._ways else ()
        for way in ways:
            try:
                self._socket.sendto(data, way)
            except OSError:  # it is gone; its silence is told of
                continue

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _system_of(datagram: bytes) -> int:
    """Return the system id of the first frame, 0 when there is none."""
    place = {0xFD: 5, 0xFE: 3}.get(datagram[0] if datagram else 0, 1 << 16)
    return datagram[place] if len(datagram) > place else 0


class Tcp:
    """One stream; see ``Line``."""

    def __init__(self, host: str, port: int) -> None:
        """Connect.

        Raises:
            OSError: nobody takes the connection.
        """
        self.where = f"TCP {host}:{port}"
        self.unreachable = False
        self._rest = b""
        self._socket = socket.create_connection((host, port), timeout=_CONNECT_LIMIT)

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._socket.fileno()

    def receive(self) -> list[bytes]:
        """Return the frames that have come.

        Raises:
            GcsError: the other end has closed.
        """
        try:
            data = self._socket.recv(_LARGEST_DATAGRAM)
        except OSError as error:
            raise GcsError(f"{self.where}: the connection is broken: {error.strerror}") from error
        if not data:
            raise GcsError(f"{self.where}: the other end has closed the connection")
        frames, self._rest = cut(self._rest + data)
        return frames

    def send(self, data: bytes, _system: int) -> None:
        """Send a frame; waits for room a few seconds at most.

        Raises:
            GcsError: the connection is broken.
        """
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise GcsError(f"{self.where}: the connection is broken: {error.strerror or error}") from error

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


_KINDS: dict[str, Callable[[str, int], Line]] = {"udpout": UdpOut, "udpin": UdpIn, "tcp": Tcp}


def cut(stream: bytes) -> tuple[list[bytes], bytes]:
    """Cut a stream into frames; return them, and what is still to become one. What begins no frame is passed over."""
    frames = []
    start, size = 0, len(stream)
    while start < size:
        layout = _MAGIC.get(stream[start])
        if layout is None:
            start += 1
            continue
        header, overhead = layout
        if start + header > size:
            break
        signed = stream[start] == 0xFD and stream[start + 2] & _SIGNED
        end = start + stream[start + 1] + overhead + (_SIGNATURE if signed else 0)
        if end > size:
            break
        frames.append(stream[start:end])
        start = end
    return frames, stream[start:]
