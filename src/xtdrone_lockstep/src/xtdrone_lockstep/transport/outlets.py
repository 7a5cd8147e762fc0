"""The sending end of a topic connection: counts messages and never blocks.

While a subscriber keeps up, its bytes are in the kernel when ``publish`` returns and no other thread is involved.
"""

from __future__ import annotations

import socket
import threading
import time
from collections import deque
from typing import Any, Protocol

import rospy

from ..protocol import Digest

STALLED_QUEUE = 100
"""Messages kept for a stalled subscriber that is not a participant, if the publisher sets no queue size."""
GLANCE_PERIOD = 0.1
"""Wall seconds between two messages to a subscriber that needs only some of them."""


class Ledger(Protocol):
    """Records the connections and message counts of a process.

    Attributes:
        dirty: Announced outlets whose count has changed since it was last reported.
        digests: Digests of the published messages by topic; None if not requested.
        time_us: Simulation time in microseconds, for the digests.
    """

    dirty: deque[Outlet]
    digests: dict[str, Digest] | None
    time_us: int

    def outlet_made(self, outlet: Outlet) -> None:
        """Record a new connection; called in rospy's threads."""

    def outlet_lost(self, outlet: Outlet) -> None:
        """Record that a connection is closed; called in any thread."""


class Outlet:
    """The sending end of one topic connection; replaces the ``write_data`` method of rospy's transport.

    Attributes:
        topic: Resolved topic name.
        peer: The subscriber's name.
        port: The subscriber's TCP port.
        count: Messages sent or queued since the connection was made.
        number: The connection's number in this process, from 1; 0 until it is announced.
        dirty: Whether it is in ``Ledger.dirty``.
        closed: Whether the connection is closed.
        participant: Whether the subscriber is a participant; its messages are never dropped.
    """

    def __init__(self, topic: str, transport: Any, queue_size: int | None, ledger: Ledger) -> None:
        """Wrap a connection.

        Args:
            topic: Resolved topic name.
            transport: rospy's connected TCPROSTransport.
            queue_size: Messages kept for a stalled subscriber that is not a participant.
            ledger: Records the count.
        """
        self.topic = topic
        self.peer: str = transport.endpoint_id
        self.port: int = transport.remote_endpoint[1]
        self.count = 0
        self.number = 0
        self.dirty = False
        self.closed = False
        self.participant = False
        self._transport = transport
        self._queue_size = queue_size or STALLED_QUEUE
        self._ledger = ledger
        self._lock = threading.Lock()
        self._backlog: deque[bytes] = deque()
        self._draining = False

    def __call__(self, data: bytes) -> bool:
        """Send one serialised message without blocking; the caller holds the topic's publishing lock.

        Args:
            data: Length-prefixed message.

        Returns:
            True, like rospy's ``write_data``.

        Raises:
            TransportTerminated: The connection is closed.
        """
        transport = self._transport
        # The only other sender is the drain thread, and it is started only under the publishing lock.
        if not self._draining or not self._keep(data):
            sock = transport.socket
            if sock is None or transport.done:
                raise rospy.exceptions.TransportTerminated("connection closed")
            try:
                sent = sock.send(data, socket.MSG_DONTWAIT)
            except BlockingIOError:
                sent = 0
            except OSError as error:
                transport.close()
                raise rospy.exceptions.TransportTerminated(str(error)) from error
            if sent != len(data):
                self._begin_draining(sock, data[sent:])
        self.count += 1
        transport.stat_num_msg += 1
        transport.stat_bytes += len(data)
        if self.number and not self.dirty:  # one that is not announced has no reader; its announcement has the count
            self.dirty = True
            self._ledger.dirty.append(self)
        return True

    @property
    def sock(self) -> socket.socket | None:
        """The socket, for compiled code that sends in this object's place; None while a thread sends, or if closed."""
        transport = self._transport
        return None if self._draining or self.closed or transport.done else transport.socket

    def record(self, count: int, size: int, rest: bytes, failure: int) -> None:
        """Record what compiled code has sent over the socket.

        Args:
            count: Messages sent or queued since the connection was made.
            size: Their bytes since the last record.
            rest: Bytes of the last message that the kernel has not accepted.
            failure: errno if the connection is broken, else 0.
        """
        transport = self._transport
        transport.stat_num_msg += count - self.count
        transport.stat_bytes += size
        self.count = count
        if rest and transport.socket is not None:
            self._begin_draining(transport.socket, rest)
        if failure:
            transport.close()

    def _begin_draining(self, sock: socket.socket, rest: bytes) -> None:
        """Send the rest of a message in a thread: the subscriber does not keep up, and this node must not block."""
        self._draining = True
        self._backlog.append(rest)
        threading.Thread(target=self._drain, args=(sock,), name=f"drain {self.topic}", daemon=True).start()

    def _keep(self, data: bytes) -> bool:
        """Queue a message for the drain thread; return False if that thread has just ended."""
        with self._lock:
            if not self._draining:
                return False
            # The first entry may be the rest of a partially sent message and must not be dropped.
            if not self.participant and len(self._backlog) > self._queue_size:
                del self._backlog[1]
                self.count -= 1
            self._backlog.append(data)
            return True

    def _drain(self, sock: socket.socket) -> None:
        while True:
            with self._lock:
                if not self._backlog:
                    self._draining = False
                    return
                data = self._backlog[0]
            try:
                sock.sendall(data)
            except OSError:
                self._transport.close()
                return
            with self._lock:
                self._backlog.popleft()


class RareOutlet(Outlet):
    """The sending end to a subscriber that needs only one message in each ``GLANCE_PERIOD``."""

    _next = 0.0

    def __call__(self, data: bytes) -> bool:
        """Send one serialised message like ``Outlet``, or discard it."""
        now = time.monotonic()
        if now < self._next:
            return True
        self._next = now + GLANCE_PERIOD
        return super().__call__(data)
