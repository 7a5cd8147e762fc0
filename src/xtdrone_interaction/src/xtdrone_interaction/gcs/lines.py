"""Lines to vehicles: bytes in, bytes out; nothing here blocks once a line is open."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from typing import Protocol

import serial

from .peers import ANY, GcsError

_RECEIVE_BUFFER = 1 << 20  # whoever speaks to a vehicle hears its telemetry, too
_LARGEST_DATAGRAM = 65535
_OPENING_LIMIT = 5.0  # s for a TCP connection, and for a serial port to take a frame
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

    Args:
        scheme: one of ``SCHEMES``.
        host, port: name or address and port; with ``serial`` the device and its baud rate.

    Raises:
        GcsError: it cannot be opened.
    """
    try:
        return _KINDS[scheme](host, port)
    except (OSError, ValueError) as error:  # ValueError: no such baud rate, nor a host's name
        number = getattr(error, "errno", None)
        reason = os.strerror(number) if number and number > 0 else str(error)  # those below are of name resolution
        verb = {"udpin": "bound", "serial": "opened"}.get(scheme, "reached")
        raise GcsError(f"{_where(scheme, host, port)} cannot be {verb}: {reason}") from error


def _where(scheme: str, host: str, port: int) -> str:
    if scheme == "serial":
        return f"{host} at {port} baud"
    words = {"udpout": "UDP", "udpin": "UDP port", "tcp": "TCP"}
    return f"{words[scheme]} {host}:{port}"


class _Udp:
    """A UDP socket; see ``Line``."""

    def __init__(self, where: str, attach: Callable[[socket.socket], None]) -> None:
        """Open it; ``attach`` connects or binds it.

        Raises:
            OSError: that cannot be.
        """
        self.where = where
        self.unreachable = False
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self._socket.setblocking(False)
            attach(self._socket)
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
            except ConnectionRefusedError:  # what was sent before found nobody
                self.unreachable = True
            except OSError:
                break
            else:
                self._note(datagram, sender)
                found.append(datagram)
        if found:
            self.unreachable = False
        return found

    def _note(self, datagram: bytes, sender: tuple[str, int]) -> None:
        """Take note of who has sent a datagram."""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class UdpOut(_Udp):
    """We speak first, to one port; see ``Line``."""

    def __init__(self, host: str, port: int) -> None:
        """Open it.

        Raises:
            OSError: there is no way to the host.
        """
        super().__init__(_where("udpout", host, port), lambda sock: sock.connect((host, port)))

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


class UdpIn(_Udp):
    """Vehicles speak first, to our port; see ``Line``."""

    def __init__(self, host: str, port: int) -> None:
        """Bind the port.

        Raises:
            OSError: it is taken, or there is no such address here.
        """
        super().__init__(_where("udpin", host, port), lambda sock: sock.bind((host, port)))
        self._ways: dict[int, tuple[str, int]] = {}

    def _note(self, datagram: bytes, sender: tuple[str, int]) -> None:
        system = _system_of(datagram)
        if system:
            self._ways[system] = sender

    def send(self, data: bytes, system: int) -> None:
        """Send a datagram where that system has spoken from; nowhere while it has not, everywhere for ``ANY``."""
        ways = set(self._ways.values()) if system == ANY else {self._ways[system]} if system in self._ways else ()
        for way in ways:
            try:
                self._socket.sendto(data, way)
            except OSError:  # it is gone; its silence is told of
                continue


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
        self.where = _where("tcp", host, port)
        self.unreachable = False
        self._rest = b""
        self._socket = socket.create_connection((host, port), timeout=_OPENING_LIMIT)

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


class SerialPort:
    """A telemetry radio, or an autopilot's USB port; see ``Line``."""

    def __init__(self, device: str, baud: int) -> None:
        """Open it, for nobody else.

        Raises:
            OSError: there is no such device, it may not be used, or somebody else has it.
            ValueError: it does not run at this baud rate.
        """
        self.where = _where("serial", device, baud)
        self.unreachable = False
        self._rest = b""
        self._port = serial.Serial(device, baud, timeout=0.0, write_timeout=_OPENING_LIMIT, exclusive=True)

    def fileno(self) -> int:
        """Return the device's descriptor."""
        return int(self._port.fileno())

    def receive(self) -> list[bytes]:
        """Return the frames that have come.

        Raises:
            GcsError: the device is gone.
        """
        try:
            data = self._port.read(_LARGEST_DATAGRAM)
        except OSError as error:
            raise GcsError(f"{self.where}: the device is gone: {error}") from error
        frames, self._rest = cut(self._rest + data)
        return frames

    def send(self, data: bytes, _system: int) -> None:
        """Send a frame; waits for room a few seconds at most.

        Raises:
            GcsError: the device is gone, or takes nothing.
        """
        try:
            self._port.write(data)
        except OSError as error:
            raise GcsError(f"{self.where}: the device takes nothing: {error}") from error

    def close(self) -> None:
        """Close the device."""
        self._port.close()


_KINDS: dict[str, Callable[[str, int], Line]] = {
    "udpout": UdpOut,
    "udpin": UdpIn,
    "tcp": Tcp,
    "serial": SerialPort,
}


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
