"""The server's sockets: accepts connections, receives frames, sends without blocking, and limits what clients may use.

Runs entirely inside ``ClientConnections.poll``, without threads. A faulty client only ever loses its own connection.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from itertools import islice

from xtdrone_native import lockstep_io

from .. import unix_sockets
from ..protocol import Kind, ProtocolError, pack_object, tune
from .client_process import ClientConnection
from .frame_checks import RefusalError

Log = Callable[[int, str], None]
"""Called with a level of ``logging`` and a text."""
HandleFrame = Callable[[ClientConnection, int, bytes], None]
"""Called with the connection, type and payload of each frame; raises ProtocolError or RefusalError if it is invalid."""
EndTurn = Callable[[ClientConnection, Mapping[int, int]], None]
"""Called with the connection of each DONE that was awaited, once its counts of channels are routed, and with its counts
of datagrams by port; raises ProtocolError if they are invalid."""

GREETING_LIMIT = 10.0
"""Wall seconds that a connection may stay open without a JOIN or RESERVE."""
RESERVATION_LIMIT = 60.0
"""Wall seconds that a name may stay reserved without a JOIN, unless its owner is a living process on this machine."""
CHECK_PERIOD = 0.5
"""Wall seconds between checks of these limits."""
GREETING_BUDGET = 0.05
"""Wall seconds of one ``poll`` spent on connections that have not joined; the rest is left for the next."""
FRAMES_PER_POLL = 256
"""Frames of one connection handled in one ``poll``; a starting node sends one for each of its topic connections."""
MOST_NEWCOMERS = 256
"""Connections that have not joined; beyond it the oldest one from the address with most of them is closed."""
MOST_UNFINISHED = 1 << 27
"""Bytes of incomplete frames of all connections; beyond it the connection with most of them is closed."""
LONG_FRAME = 1 << 16
"""Bytes of an incomplete frame above which this total is checked."""
MOST_CONNECTIONS = 4096
MOST_PER_ADDRESS = 2048
"""Connections from one address."""
MOST_UNSENT = 1 << 27
"""Bytes waiting for a client that does not read."""
MOST_REASON = 2000
"""Characters of the reason in a REFUSED frame."""
COMPLAINT_PERIOD = 5.0
"""Wall seconds between warnings about connections that have not joined; there may be any number of these."""


class ClientConnections:
    """The listening socket and the connections of all clients.

    Attributes:
        uri: Address to connect to, tcp://host:port.
        reserved: Connections by the name that they have reserved.
    """

    def __init__(
        self,
        host: str,
        port: int,
        log: Log,
        handle_frame: HandleFrame,
        end_turn: EndTurn,
        on_close: Callable[[ClientConnection], None],
    ) -> None:
        """Open the listening sockets.

        Args:
            host: Address to listen on; "0.0.0.0" for all interfaces.
            port: TCP port, 0 for any free one.
            log: Receives log messages.
            handle_frame: Called with each frame, except those passed to ``end_turn``.
            end_turn: Called with each DONE that was awaited.
            on_close: Called after a connection has been closed.

        Raises:
            OSError: The address or port cannot be used.
        """
        self._log = log
        self._handle_frame = handle_frame
        self._end_turn = end_turn
        self._on_close = on_close
        listener = socket.create_server((host, port), backlog=1024)
        address, number = listener.getsockname()[:2]
        self._listeners = {
            one.fileno(): one
            for one in (listener, unix_sockets.listen(unix_sockets.SERVER, address, number))
            if one is not None
        }
        advertised = socket.gethostname() if host in {"", "0.0.0.0"} else host
        self.uri = f"tcp://{advertised}:{number}"
        self.reserved: dict[str, ClientConnection] = {}
        self._epoll = select.epoll()
        self._exchange = lockstep_io.Exchange(self._epoll.fileno())
        self._listening = True
        for descriptor, one in self._listeners.items():
            one.setblocking(False)
            self._epoll.register(descriptor, select.EPOLLIN)
        # Readable while there is a backlog, i.e. connections with received frames that have not been handled.
        self._backlog_event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll.register(self._backlog_event, select.EPOLLIN)
        self._backlog: dict[ClientConnection, None] = {}
        self._open: dict[int, ClientConnection] = {}
        self._per_address: dict[str, int] = {}
        self._newcomers: dict[ClientConnection, None] = {}  # have neither joined nor reserved a name; oldest first
        self._next_check = 0.0
        self._last_refusal = ""
        self._next_complaint = 0.0
        self._suppressed_complaints = 0

    def __len__(self) -> int:
        """Return the number of open connections."""
        return len(self._open)

    def fileno(self) -> int:
        """Return a file descriptor that is readable when ``poll`` has work to do."""
        return self._epoll.fileno()

    # ---- polling ----

    def poll(self, timeout: float) -> None:
        """Accept connections, handle received frames and close connections that exceed a limit.

        Participants are served first. Newcomers get at most ``GREETING_BUDGET`` seconds, and at most
        ``FRAMES_PER_POLL`` frames per connection are handled; the rest is left for the next call (see ``fileno``).

        Args:
            timeout: Longest wait in wall seconds.
        """
        backlog = list(self._backlog)
        newcomers: list[ClientConnection] = []
        knocks: list[socket.socket] = []
        completed, others = self._exchange.poll(timeout)
        if completed:
            self._end_turns(completed)
        for descriptor, event, data, error in others:
            connection = self._open.get(descriptor)
            if connection is None:  # a listener, the backlog event, or a connection closed in this loop
                if descriptor in self._listeners:
                    knocks.append(self._listeners[descriptor])
            elif data is not None:
                self._accept_data(connection, data)
            elif error:
                self.drop(connection, f"is gone: {OSError(error, os.strerror(error))}")
            elif not connection.name:
                newcomers.append(connection)
            else:
                if event & select.EPOLLOUT:
                    self._flush(connection)
                if event & (select.EPOLLIN | select.EPOLLHUP | select.EPOLLERR):
                    self._receive(connection)
        for connection in backlog:
            self._handle_frames(connection)
        if newcomers or knocks:
            self._greet(newcomers, knocks)
        if self._newcomers or self.reserved or not self._listening:
            self._close_overdue()

    def _end_turns(self, completed: Iterable[tuple[int, Mapping[int, int] | None]]) -> None:
        now = time.monotonic()
        for descriptor, ports in completed:
            connection = self._open[descriptor]
            connection.heard = now
            try:
                self._end_turn(connection, ports or {})
            except ProtocolError as error:
                self.drop(connection, f"sent an invalid lockstep frame: {error}")

    def _greet(self, newcomers: Iterable[ClientConnection], knocks: Iterable[socket.socket]) -> None:
        """Serve connections that have not joined and accept more, for ``GREETING_BUDGET`` seconds.

        Unread data and pending connections stay in the kernel.
        """
        end = time.monotonic() + GREETING_BUDGET
        for connection in newcomers:
            if time.monotonic() >= end:
                return
            self._flush(connection)
            self._receive(connection)
        for listener in knocks:
            while self._listening and time.monotonic() < end and self._accept(listener):
                continue

    def _accept(self, listener: socket.socket) -> bool:
        """Accept a pending connection; return whether there was one."""
        try:
            sock, address = listener.accept()
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno in {errno.EMFILE, errno.ENFILE}:
                self._listen(False)
            self._complain(f"cannot accept a connection to {self.uri}: {error}")
            return False
        sock.setblocking(False)
        is_local = sock.family == socket.AF_UNIX
        if not is_local:
            tune(sock)
        elif not unix_sockets.has_same_owner(sock):
            sock.close()
            return True
        connection = ClientConnection(sock, None if is_local else address, time.monotonic())
        self._open[connection.descriptor] = connection
        self._per_address[connection.host] = self._per_address.get(connection.host, 0) + 1
        self._newcomers[connection] = None
        self._epoll.register(sock.fileno(), select.EPOLLIN)
        count = self._per_address[connection.host]
        if len(self._open) > MOST_CONNECTIONS or count > MOST_PER_ADDRESS:
            limits = f"the limit is {MOST_PER_ADDRESS} per address and {MOST_CONNECTIONS} in total"
            self._refuse(connection, "full", f"there are {count} connections from {connection.host}, {limits}")
            return True
        if len(self._newcomers) > MOST_NEWCOMERS:
            self._close_oldest_newcomer()
        # Its JOIN has usually arrived already; the node then takes part in the next tick.
        self._receive(connection)
        return True

    def _listen(self, enabled: bool) -> None:
        """Accept new connections, or leave them in the kernel."""
        if enabled != self._listening:
            self._listening = enabled
            for descriptor in self._listeners:
                self._epoll.modify(descriptor, select.EPOLLIN if enabled else 0)

    # ---- receiving ----

    def _receive(self, connection: ClientConnection) -> None:
        if connection.sock is None or connection in self._backlog:
            return
        try:
            data = connection.sock.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError as error:
            self.drop(connection, f"is gone: {error}")
            return
        self._accept_data(connection, data)

    def _accept_data(self, connection: ClientConnection, data: bytes) -> None:
        """Handle data received on a connection; none if the client has closed it."""
        if not data:
            self.drop(connection, "is gone: it closed its connection without a LEAVE")
            return
        connection.heard = time.monotonic()
        connection.reader.feed(data)
        self._handle_frames(connection)

    def _handle_frames(self, connection: ClientConnection) -> None:
        """Handle the frames received on a connection; an invalid one closes this connection only."""
        if connection.sock is None:
            return
        try:
            for kind, payload in islice(connection.reader.frames(), FRAMES_PER_POLL):
                self._handle_frame(connection, kind, payload)
                if not connection.is_open:
                    return
        except RefusalError as error:
            self._refuse(connection, error.code, str(error))
        except ProtocolError as error:
            self.drop(connection, f"sent an invalid lockstep frame: {error}")
        self._exchange.hold(connection.descriptor, bool(connection.reader))
        if connection.reader or self._backlog:  # rare: a frame usually arrives whole and alone
            self._set_backlog(connection, connection.is_open and connection.reader.has_frame())
            if len(connection.reader) > LONG_FRAME:
                self._limit_unfinished()

    def _set_backlog(self, connection: ClientConnection, value: bool) -> None:
        """Record whether a connection has frames that have not been handled; ``fileno`` is readable while any has."""
        if value == (connection in self._backlog):
            return
        if not value:
            del self._backlog[connection]
            if not self._backlog:
                os.eventfd_read(self._backlog_event)
            return
        if not self._backlog:
            os.eventfd_write(self._backlog_event, 1)
        self._backlog[connection] = None

    # ---- sending ----

    def send(self, connection: ClientConnection, data: bytes) -> None:
        """Send frames without blocking; bytes that the kernel does not accept are sent by a later ``poll``."""
        if connection.sock is None:
            return
        if connection.unsent:
            connection.unsent += data
            if len(connection.unsent) > MOST_UNSENT:
                self.drop(connection, f"does not read: {len(connection.unsent)} bytes are waiting to be sent to it")
            return
        try:
            sent = connection.sock.send(data)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            self.drop(connection, f"is gone: {error}")
            return
        if sent < len(data):
            self._keep(connection, data[sent:])

    def _keep(self, connection: ClientConnection, data: bytes) -> None:
        """Keep bytes until the client reads."""
        connection.unsent += data
        self._epoll.modify(connection.descriptor, select.EPOLLIN | select.EPOLLOUT)

    def _flush(self, connection: ClientConnection) -> None:
        data, connection.unsent = bytes(connection.unsent), bytearray()
        if data and connection.sock is not None:
            self._epoll.modify(connection.descriptor, select.EPOLLIN)
            self.send(connection, data)

    def send_ticks(self, tick: int, time_us: int, rows: Iterable[tuple[ClientConnection, dict[int, int]]]) -> None:
        """Send TICK without datagram counts, and await the DONE of each.

        Args:
            tick: Number of the tick.
            time_us: Simulation time in microseconds.
            rows: Connections with no unsent bytes, and their counts by channel, which are cleared.
        """
        descriptors = [(connection.descriptor, counts) for connection, counts in rows]
        for descriptor, rest, error in self._exchange.send(tick, time_us, descriptors):
            connection = self._open[descriptor]
            if error:
                self.drop(connection, f"is gone: {OSError(error, os.strerror(error))}")
            else:
                self._keep(connection, rest)

    def expect(self, connection: ClientConnection, tick: int) -> None:
        """Await the DONE of a tick whose TICK is sent by ``send``."""
        self._exchange.expect(connection.descriptor, tick)

    def release(self, connection: ClientConnection) -> None:
        """Stop awaiting DONE."""
        self._exchange.release(connection.descriptor)

    # ---- names ----

    def reserve(self, connection: ClientConnection, name: str) -> None:
        """Record the name reserved over a connection."""
        connection.reserved = name
        connection.accepted = time.monotonic()
        self.reserved[name] = connection
        self._newcomers.pop(connection, None)

    def join(
        self, connection: ClientConnection, name: str, routes: dict[int, tuple[dict[int, int], int]], closing: list[int]
    ) -> None:
        """Record the participant that has joined over a connection.

        Args:
            connection: The connection.
            name: Name of the participant.
            routes: Where the counts of its DONE go, see ``Outgoing``.
            closing: Its closed connections, see ``Outgoing``; while there are any, ``HandleFrame`` gets its DONE.
        """
        connection.name = name
        self._exchange.add(connection.descriptor, routes, closing)
        self._newcomers.pop(connection, None)
        self.reserved.pop(connection.reserved, None)

    # ---- closing ----

    def drop(self, connection: ClientConnection, why: str) -> None:
        """Close the connection of a client that is dead, hung or faulty.

        Args:
            connection: The connection.
            why: Reason, as a predicate: "is gone: ...".
        """
        if connection.sock is None:
            return
        if connection.name:
            self._log(logging.WARNING, f"{connection} {why}; dropped, the simulation goes on")
        elif connection.reserved:
            self._log(logging.INFO, f"{connection.reserved}, which has not joined, {why}")
        elif connection.heard == connection.accepted:
            self._log(logging.DEBUG, f"{connection} {why}")
        else:
            self._complain(f"{connection} {why}")
        self._close_with(connection, "dropped", f"it {why}")

    def remove(self, connection: ClientConnection) -> None:
        """Close a connection."""
        if connection.sock is not None:
            self._exchange.remove(connection.descriptor)
            self._epoll.unregister(connection.descriptor)
            del self._open[connection.descriptor]
            self._newcomers.pop(connection, None)
            self._set_backlog(connection, False)
            left = self._per_address[connection.host] - 1
            if left:
                self._per_address[connection.host] = left
            else:
                del self._per_address[connection.host]
            connection.sock.close()
            connection.sock = None
            self._listen(True)
        if self.reserved.get(connection.reserved) is connection:
            del self.reserved[connection.reserved]
        self._on_close(connection)

    def excuse(self, seconds: float, now: float) -> None:
        """Exclude a period in which this process did not run from the silence of all clients.

        Args:
            seconds: Length of the period.
            now: Monotonic wall time in seconds.
        """
        for connection in self._open.values():
            connection.heard = min(connection.heard + seconds, now)

    def close(self, farewell: bytes) -> None:
        """Close everything, after an attempt to send ``farewell`` to every client."""
        for connection in self._open.values():
            if connection.sock is not None:
                with contextlib.suppress(OSError):
                    connection.sock.send(bytes(connection.unsent) + farewell)
                connection.sock.close()
                self._exchange.remove(connection.descriptor)
        for table in (self._open, self._newcomers, self.reserved, self._backlog):
            table.clear()
        self._epoll.close()
        os.close(self._backlog_event)
        for listener in self._listeners.values():
            listener.close()

    def _refuse(self, connection: ClientConnection, code: str, reason: str) -> None:
        repeated, self._last_refusal = reason == self._last_refusal, reason
        if repeated:  # a node that waits for its name retries many times a second
            self._log(logging.DEBUG, f"refused: {reason}")
        else:
            self._complain(f"refused: {reason}")
        self._close_with(connection, code, reason)

    def _close_with(self, connection: ClientConnection, code: str, reason: str) -> None:
        """Send REFUSED and close; a single attempt, as the client may be dead or not reading."""
        refusal = pack_object(Kind.REFUSED, {"code": code, "reason": reason[:MOST_REASON]})
        try:
            if connection.sock is not None:
                connection.sock.send(refusal)
        except OSError:
            self._log(logging.DEBUG, f"could not send {connection.name or connection.address} the reason: {reason}")
        self.remove(connection)

    # ---- limits ----

    def _close_oldest_newcomer(self) -> None:
        count: dict[str, int] = {}
        for newcomer in self._newcomers:
            count[newcomer.host] = count.get(newcomer.host, 0) + 1
        crowd = max(count, key=lambda host: count[host])
        oldest = next(newcomer for newcomer in self._newcomers if newcomer.host == crowd)
        self.drop(oldest, f"is one of more than {MOST_NEWCOMERS} that have not joined")

    def _limit_unfinished(self) -> None:
        unfinished = sum(len(connection.reader) for connection in self._open.values())
        if unfinished > MOST_UNFINISHED:
            longest = max(self._open.values(), key=lambda connection: len(connection.reader))
            limit = f"of {unfinished} in total, the limit is {MOST_UNFINISHED}"
            self.drop(longest, f"has sent {len(longest.reader)} bytes of an incomplete frame, {limit}")

    def _close_overdue(self) -> None:
        """Close connections that have not joined in time, and release names reserved for too long."""
        now = time.monotonic()
        if now < self._next_check:
            return
        self._next_check = now + CHECK_PERIOD
        self._listen(True)
        for connection in [newcomer for newcomer in self._newcomers if now - newcomer.accepted > GREETING_LIMIT]:
            self.drop(connection, f"did not join within {GREETING_LIMIT:g} s")
        for connection in list(self.reserved.values()):
            process = connection.process
            if process is not None and not process.state():
                self.drop(connection, f"is gone: its process {process.pid} has ended")
            elif process is None and now - connection.accepted > RESERVATION_LIMIT:
                self.drop(connection, f"did not join within {RESERVATION_LIMIT:g} s of reserving its name")

    def _complain(self, text: str) -> None:
        """Warn about a connection that has not joined, at most once in ``COMPLAINT_PERIOD`` seconds."""
        now = time.monotonic()
        if now < self._next_complaint:
            self._suppressed_complaints += 1
            self._log(logging.DEBUG, text)
            return
        more = f" (and {self._suppressed_complaints} similar ones before)" if self._suppressed_complaints else ""
        self._next_complaint, self._suppressed_complaints = now + COMPLAINT_PERIOD, 0
        self._log(logging.WARNING, text + more)
