"""Connections to vehicles over UDP, TCP and serial ports: frames in, frames out, without blocking once they are open.

pymavlink's connections are not used: they print to standard output, reconnect on their own, hide errors of sending, and
parse every message of the telemetry in Python.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from typing import Any

import serial

from .vehicle_addresses import ANY, GcsError

_RECEIVE_BUFFER = 1 << 20  # bytes: a vehicle streams its telemetry to every client
_LARGEST_DATAGRAM = 65535
_OPENING_LIMIT = 5.0  # s to open a TCP connection, and for a stream to accept a frame
_MOST_DATAGRAMS = 4096  # per call, so that a flood on one connection does not block the others
_SYSTEM_OFFSET = {0xFD: 5, 0xFE: 3}  # position of the system id in a frame, by first byte
_FRAME_SIZES = {0xFD: (10, 12), 0xFE: (6, 8)}  # size of the header, and of all but the payload, by first byte
_SIGNED, _SIGNATURE_SIZE = 0x01, 13


class Connection:
    """A carrier of MAVLink frames.

    Attributes:
        where: Name in error messages.
        unreachable: Whether the other end refused the last datagram (UDP: no program has the port).
    """

    def __init__(self, where: str, port: Any) -> None:
        """Carry them over ``port``, an open socket or serial port."""
        self.where = where
        self.unreachable = False
        self._port = port

    def fileno(self) -> int:
        """Return the descriptor that is readable when frames have arrived."""
        return int(self._port.fileno())

    def close(self) -> None:
        """Close the connection."""
        self._port.close()

    def receive(self) -> list[bytes]:
        """Return the chunks that have arrived, each of one or more whole frames.

        Raises:
            GcsError: the connection has ended.
        """
        raise NotImplementedError

    def send(self, frame: bytes, system: int) -> None:
        """Send a frame to a system; a stream waits up to a few seconds for a full buffer.

        Raises:
            GcsError: the connection is broken.
        """
        raise NotImplementedError


def open_connection(scheme: str, host: str, port: int) -> Connection:
    """Open a connection.

    Args:
        scheme: one of ``vehicle_addresses.SCHEMES``.
        host, port: host name or address, and port; for ``serial`` the device and its baud rate.

    Raises:
        GcsError: it cannot be opened.
    """
    try:
        return _KINDS[scheme](host, port)
    except (OSError, ValueError) as error:  # ValueError: unsupported baud rate, malformed host name
        number = getattr(error, "errno", None)
        reason = os.strerror(number) if number and number > 0 else str(error)  # negative numbers: name resolution
        verb = {"udpin": "bound", "serial": "opened"}.get(scheme, "reached")
        raise GcsError(f"{_where(scheme, host, port)} cannot be {verb}: {reason}") from error


def _where(scheme: str, host: str, port: int) -> str:
    if scheme == "serial":
        return f"{host} at {port} baud"
    words = {"udpout": "UDP", "udpin": "UDP port", "tcp": "TCP"}
    return f"{words[scheme]} {host}:{port}"


class _Udp(Connection):
    """A UDP socket."""

    def __init__(self, where: str, attach: Callable[[socket.socket], None]) -> None:
        """Open the socket; ``attach`` connects or binds it."""
        super().__init__(where, socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        try:
            self._port.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self._port.setblocking(False)
            attach(self._port)
        except OSError:
            self._port.close()
            raise

    def receive(self) -> list[bytes]:
        found: list[bytes] = []
        while len(found) < _MOST_DATAGRAMS:
            try:
                datagram, sender = self._port.recvfrom(_LARGEST_DATAGRAM)
            except ConnectionRefusedError:  # the reply to an earlier datagram
                self.unreachable = True
            except OSError:
                break
            else:
                self._store_sender(datagram, sender)
                found.append(datagram)
        if found:
            self.unreachable = False
        return found

    def _store_sender(self, datagram: bytes, sender: tuple[str, int]) -> None:
        """Store the address of the system that has sent a datagram."""


class _UdpOut(_Udp):
    """A UDP socket for one remote port, on which we speak first."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(_where("udpout", host, port), lambda sock: sock.connect((host, port)))

    def send(self, frame: bytes, _system: int) -> None:
        try:
            self._port.send(frame)
        except ConnectionRefusedError:  # the reply to an earlier datagram
            self.unreachable = True
        except BlockingIOError:  # lost, like a datagram on its way
            pass
        except OSError as error:
            raise GcsError(f"{self.where} cannot be reached: {error.strerror}") from error


class _UdpIn(_Udp):
    """A UDP socket on a local port, to which vehicles speak first."""

    def __init__(self, host: str, port: int) -> None:
        super().__init__(_where("udpin", host, port), lambda sock: sock.bind((host, port)))
        self._addresses: dict[int, tuple[str, int]] = {}  # by system id

    def _store_sender(self, datagram: bytes, sender: tuple[str, int]) -> None:
        system = _system_of(datagram)
        if system:
            self._addresses[system] = sender

    def send(self, frame: bytes, system: int) -> None:
        """Send to the last address of a system, which may have none yet, or for ``ANY`` to all addresses."""
        known = self._addresses
        addresses = set(known.values()) if system == ANY else {known[system]} if system in known else ()
        for address in addresses:
            try:
                self._port.sendto(frame, address)
            except OSError:  # the vehicle is gone; its silence is reported
                continue


def _system_of(datagram: bytes) -> int:
    """Return the system id of a datagram's first frame; 0 for none."""
    offset = _SYSTEM_OFFSET.get(datagram[0] if datagram else 0, 1 << 16)
    return datagram[offset] if len(datagram) > offset else 0


class _Stream(Connection):
    """A stream of bytes, split into frames."""

    def __init__(self, where: str, port: Any) -> None:
        super().__init__(where, port)
        self._rest = b""

    def _split(self, data: bytes) -> list[bytes]:
        frames, self._rest = split_stream(self._rest + data)
        return frames


class _Tcp(_Stream):
    """A TCP connection."""

    def __init__(self, host: str, port: int) -> None:
        line = socket.create_connection((host, port), timeout=_OPENING_LIMIT)
        super().__init__(_where("tcp", host, port), line)

    def receive(self) -> list[bytes]:
        try:
            data = self._port.recv(_LARGEST_DATAGRAM)
        except OSError as error:
            raise GcsError(f"{self.where}: the connection is broken: {error.strerror}") from error
        if not data:
            raise GcsError(f"{self.where}: the other end has closed the connection")
        return self._split(data)

    def send(self, frame: bytes, _system: int) -> None:
        try:
            self._port.sendall(frame)
        except OSError as error:
            raise GcsError(f"{self.where}: the connection is broken: {error.strerror or error}") from error


class _SerialPort(_Stream):
    """A telemetry radio or an autopilot's USB port, locked against other programs."""

    def __init__(self, device: str, baud: int) -> None:
        line = serial.Serial(device, baud, timeout=0.0, write_timeout=_OPENING_LIMIT, exclusive=True)
        super().__init__(_where("serial", device, baud), line)

    def receive(self) -> list[bytes]:
        try:
            return self._split(self._port.read(_LARGEST_DATAGRAM))
        except OSError as error:
            raise GcsError(f"{self.where}: the device is gone: {error}") from error

    def send(self, frame: bytes, _system: int) -> None:
        try:
            self._port.write(frame)
        except OSError as error:
            raise GcsError(f"{self.where}: the device accepts no data: {error}") from error


_KINDS: dict[str, Callable[[str, int], Connection]] = {
    "udpout": _UdpOut,
    "udpin": _UdpIn,
    "tcp": _Tcp,
    "serial": _SerialPort,
}


def split_stream(stream: bytes) -> tuple[list[bytes], bytes]:
    """Split a byte stream into frames, skipping bytes between them.

    Returns:
        The complete frames, and the rest: the beginning of the next frame.
    """
    frames = []
    start, size = 0, len(stream)
    while start < size:
        sizes = _FRAME_SIZES.get(stream[start])
        if sizes is None:
            start += 1
            continue
        header, overhead = sizes
        if start + header > size:
            break
        signed = stream[start] == 0xFD and stream[start + 2] & _SIGNED
        end = start + stream[start + 1] + overhead + (_SIGNATURE_SIZE if signed else 0)
        if end > size:
            break
        frames.append(stream[start:end])
        start = end
    return frames, stream[start:]
