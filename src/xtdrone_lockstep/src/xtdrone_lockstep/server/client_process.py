"""One client's connection to the lockstep server, and the process behind it."""

from __future__ import annotations

import socket

from ..protocol import FrameReader, same_machine
from .frame_checks import BEFORE_JOIN

THIS_MACHINE = "127.0.0.1"
"""Address of the clients of the Unix domain socket."""


class Process:
    """A process on this machine, distinguished from a later process with the same pid by its start time."""

    def __init__(self, pid: int) -> None:
        """Record the start time of a running process.

        Args:
            pid: Id of the process.
        """
        self.pid = pid
        self._start_time = self._stat()[1]

    def state(self) -> str:
        """Return the kernel's letter for the process state (``t``: stopped by a debugger), empty if it has ended."""
        state, start_time = self._stat()
        return "" if start_time != self._start_time or state in "ZX" else state

    def _stat(self) -> tuple[str, str]:
        """Return state and start time, fields 3 and 22 of /proc/pid/stat; empty if there is no such process."""
        try:
            with open(f"/proc/{self.pid}/stat", encoding="ascii", errors="replace") as file:
                # Field 2, the program's name in parentheses, may contain anything.
                fields = file.read().rpartition(")")[2].split()
        except OSError:
            return "", ""
        return fields[0], fields[19]


class ClientConnection:
    """A client's TCP or Unix domain connection, from ``accept`` until it is closed.

    Attributes:
        sock: The socket; None once the connection is closed.
        descriptor: Its file descriptor.
        host: IP address of the client; ``THIS_MACHINE`` over a Unix domain socket.
        address: Host and port of the client; ``THIS_MACHINE`` over a Unix domain socket.
        remote: Whether the client runs on another machine.
        name: Resolved ROS name of the participant, such as /follower_1; empty until it has joined.
        reserved: Name reserved over this connection; empty if none.
        process: The client's process if it runs on this machine, else None.
        accepted: Monotonic wall time in seconds at which it connected or reserved its name.
        heard: Monotonic wall time in seconds at which data was last received.
        reader: Splits the received bytes into frames.
        unsent: Bytes waiting until the client reads.
    """

    def __init__(self, sock: socket.socket, address: tuple[str, int] | None, now: float) -> None:
        """Wrap an accepted socket.

        Args:
            sock: The connected socket.
            address: IP address and port of the client; None over a Unix domain socket.
            now: Monotonic wall time in seconds.
        """
        self.sock: socket.socket | None = sock
        self.descriptor = sock.fileno()
        self.host = self.address = THIS_MACHINE
        self.remote = False
        if address is not None:
            self.host = address[0]
            self.address = f"{address[0]}:{address[1]}"
            self.remote = not same_machine(address[0], sock.getsockname()[0])
        self.name = ""
        self.reserved = ""
        self.process: Process | None = None
        self.accepted = now
        self.heard = now
        self.reader = FrameReader(BEFORE_JOIN)
        self.unsent = bytearray()

    @property
    def is_open(self) -> bool:
        """Whether the connection is open."""
        return self.sock is not None

    def __str__(self) -> str:
        """Return a description for log messages."""
        return f"participant {self.name}" if self.name else f"the connection from {self.address}"
