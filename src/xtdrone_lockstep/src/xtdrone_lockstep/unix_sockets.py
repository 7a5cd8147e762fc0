"""Unix domain sockets beside TCP ports, for connections within one machine.

A program that listens on a TCP port also listens on an abstract Unix domain socket, whose address contains that of the
port: it belongs to the same network namespace and ends with the program. Both ends accept only processes of the same
user; all others, and other machines, use TCP.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct

from .protocol import same_machine

SERVER = "server"
"""Kind of the lockstep server's socket."""
TOPICS = "topics"
"""Kind of the socket for a node's topic connections."""
_ANY = "0.0.0.0"
_CREDENTIALS = struct.Struct("3i")


class LocalSocket(socket.socket):
    """A Unix domain socket that ignores options of TCP."""

    def __init__(self, fileno: int | None = None) -> None:
        """Create a socket, or take over a descriptor."""
        super().__init__(socket.AF_UNIX, socket.SOCK_STREAM, fileno=fileno)

    def setsockopt(self, level: int, *option: object) -> None:  # type: ignore[override]
        """Set an option, unless it is one of TCP."""
        if level != socket.IPPROTO_TCP:
            super().setsockopt(level, *option)  # type: ignore[call-overload]


def listen(kind: str, host: str, port: int) -> socket.socket | None:
    """Listen beside a TCP port; None if the address is in use.

    Args:
        kind: ``SERVER`` or ``TOPICS``.
        host: IP address of the listening TCP socket.
        port: Its TCP port.
    """
    listener = socket.socket(socket.AF_UNIX)
    try:
        listener.bind(_address(kind, host, port))
        listener.listen(1024)
    except OSError:
        listener.close()
        return None
    return listener


def connect(kind: str, host: str, port: int, timeout: float, own_address: str = "") -> LocalSocket | None:
    """Connect to the socket beside a TCP port of this machine; None if there is none that belongs to the same user.

    Args:
        kind: ``SERVER`` or ``TOPICS``.
        host: Host name or IP address.
        port: TCP port.
        timeout: Limit of each operation of the new socket in wall seconds.
        own_address: Address of this end; empty for none.
    """
    try:
        addresses = {str(entry[4][0]) for entry in socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_STREAM)}
    except OSError:  # the connection by TCP gives the reason
        return None
    for address in [address for address in sorted(addresses) if _is_own(address)]:
        for listening in (address, _ANY):
            sock = LocalSocket()
            sock.settimeout(timeout)
            with contextlib.suppress(OSError):
                if own_address:
                    sock.bind(own_address)
                sock.connect(_address(kind, listening, port))
                if has_same_owner(sock):
                    return sock
            sock.close()
    return None


def has_same_owner(sock: socket.socket) -> bool:
    """Return whether the process at the other end belongs to the user of this process."""
    _, user, _ = _CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return bool(user == os.geteuid())


def _address(kind: str, host: str, port: int) -> str:
    return f"\0xtdrone-{kind}/{host}:{port}"


def _is_own(address: str) -> bool:
    """Return whether an IP address belongs to this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect((address, 1))  # sends nothing
        return same_machine(address, str(probe.getsockname()[0]))
    return False
