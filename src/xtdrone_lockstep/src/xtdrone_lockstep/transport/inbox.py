"""The receiving end of a topic connection: splits its bytes into messages and keeps these until their tick."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import rospy.core
from xtdrone_native import lockstep_io

FOREIGN_QUEUE = 1000
"""Messages kept from a publisher that is not a participant, if the subscriber sets no queue size."""
KERNEL_BUFFER = 1 << 20
"""Receive buffer in bytes requested from the kernel (it may grant less) for messages that arrive between turns."""


class Inbox:
    """The messages of one connection, in the order of sending.

    Attributes:
        publisher: The publisher's name.
        messages: Messages received and not yet dispatched: serialised if received by a feed, else message objects.
        received: Number of messages received since the connection was made.
        dropped: Number of these discarded because a foreign publisher's queue was full.
        taken: Number of these dispatched or discarded by the node's thread; written by that thread only.
        target: Number of messages to be dispatched by now; None for a foreign publisher (not a participant).
        given_up: Number of messages counted by the publisher that did not arrive.
        closed: Whether the connection is closed and fully read.
        lost: Whether the server has reported the channel as closed.
        latched: Whether the publisher latches.
        latch: The last message dispatched, if ``latched``.
        most_kept: Maximum number of messages kept from a foreign publisher.
        feed: Reads the connection; None before it is handed over, or if one of rospy's threads reads it.
        decode: Deserialises a message; returns None if that fails.
    """

    __slots__ = (
        "closed",
        "decode",
        "dropped",
        "feed",
        "given_up",
        "latch",
        "latched",
        "lost",
        "messages",
        "most_kept",
        "publisher",
        "received",
        "taken",
        "target",
    )

    def __init__(self, publisher: str) -> None:
        """Create an empty inbox of a foreign publisher."""
        self.publisher = publisher
        self.messages: deque[Any] = deque()
        self.received = 0
        self.dropped = 0
        self.taken = 0
        self.target: int | None = None
        self.given_up = 0
        self.closed = False
        self.lost = False
        self.latched = False
        self.latch: Any = None
        self.most_kept = FOREIGN_QUEUE
        self.feed: TopicFeed | None = None
        self.decode: Callable[[bytes], Any] | None = None

    def lacking(self) -> int:
        """Return the number of messages due by now that have not arrived."""
        if self.target is None:
            return 0
        return max(0, self.target - self.given_up - self.received)

    def fetch(self) -> bool:
        """Read until no message is missing or the connection has no more data available.

        Returns:
            Whether no message is missing.
        """
        if self.target is None:
            return True
        due = self.target - self.given_up
        while self.received < due:
            if self.feed is None or not self.feed.pull():
                return False
        return True

    def bound(self) -> None:
        """Discard the oldest messages of a foreign publisher beyond ``most_kept``."""
        if self.target is not None:
            return
        for _ in range(len(self.messages) - self.most_kept):
            try:
                self.messages.popleft()
            except IndexError:  # the node's thread has taken it
                return
            self.dropped += 1

    def discard(self, count: int) -> None:
        """Discard the pending ones of the first ``count`` messages, unless they are latched and thus remain valid."""
        if self.latched:
            return
        for _ in range(min(len(self.messages), count - self.given_up - self.taken - self.dropped)):
            self.messages.popleft()
            self.taken += 1

    def take(self, most_foreign: int) -> list[Any]:
        """Remove and return the messages to dispatch now.

        Args:
            most_foreign: Maximum number of messages from a foreign publisher; the newest ones are returned.
        """
        if self.target is None:
            surplus = max(0, len(self.messages) - most_foreign)
            ready = len(self.messages)
        else:
            surplus = 0
            ready = self.target - self.given_up - self.taken - self.dropped
        taken = []
        for index in range(ready):
            try:
                message = self.messages.popleft()
            except IndexError:  # given up, or discarded concurrently by rospy's thread
                break
            self.taken += 1
            if index < surplus:
                continue
            if self.decode is not None:
                message = self.decode(message)
                if message is None:
                    continue
            if self.latched:
                self.latch = message
            taken.append(message)
        return taken


class TopicFeed:
    """Splits the bytes of one connection into messages and stores them, still serialised, in its inbox.

    Created in one of rospy's threads and used in the node's own; ``close`` may be called in any thread.
    """

    def __init__(self, connection: Any, inbox: Inbox) -> None:
        """Take over a connection.

        Args:
            connection: rospy's connected TCPROSTransport.
            inbox: Receives the messages.

        Raises:
            AttributeError: The connection is closed.
        """
        self.inbox = inbox
        self.sock: socket.socket = connection.socket
        self._connection = connection
        self._close_connection = connection.close
        # Reentrant, as a signal handler in which rospy closes the topics may interrupt the node's thread in here.
        self._lock = threading.RLock()
        self._splitter = lockstep_io.Splitter()
        self._size = connection.protocol.buff_size
        with contextlib.suppress(OSError):
            if self.sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < KERNEL_BUFFER:
                self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, KERNEL_BUFFER)
        # Bytes received together with the connection's header.
        head = connection.read_buff.getvalue()[: connection.read_buff.tell()]
        connection.close = self.close
        if head:
            connection.stat_bytes += len(head)
            self._store(self._splitter.cut(head))

    def pull(self) -> bool:
        """Read once without waiting; close the connection if the publisher has closed it.

        Returns:
            Whether data was read.
        """
        with self._lock:
            try:
                read = self._splitter.read(self.sock, self._size)
            except (OSError, ValueError):  # ended or reset by the publisher, or closed concurrently
                self.inbox.closed = True
                read = None
            if read is not None:
                self._connection.stat_bytes += read[1]
                self._store(read[0])
                return True
        if self.inbox.closed:
            self._close_connection()
        return False

    def lend(self) -> lockstep_io.Splitter:
        """Return the splitter, with all messages that are not dispatched yet, to compiled code that reads the socket.

        ``take_back`` ends this.
        """
        inbox = self.inbox
        with self._lock:
            count = len(inbox.messages)
            self._splitter.put_back(list(inbox.messages))
            inbox.messages.clear()
            inbox.received -= count
            self._connection.stat_num_msg -= count
        return self._splitter

    def take_back(self, taken: int, size: int) -> None:
        """Record what compiled code has read and dispatched.

        Args:
            taken: Number of messages dispatched since the connection was made.
            size: Bytes read.
        """
        inbox = self.inbox
        with self._lock:
            count = taken - inbox.taken
            inbox.received += count
            inbox.taken = taken
            inbox.target = max(inbox.target or 0, taken + inbox.given_up)
            self._connection.stat_num_msg += count
            self._connection.stat_bytes += size
            self._store(self._splitter.cut(b""))

    def close(self) -> None:
        """Read the data at hand and close the connection; replaces the transport's ``close``."""
        if not rospy.core.is_shutdown_requested():
            while not self.inbox.closed and self.pull():
                pass
        self.inbox.closed = True
        self._close_connection()

    def _store(self, messages: list[bytes]) -> None:
        count, inbox = len(messages), self.inbox
        self._connection.stat_num_msg += count
        inbox.messages.extend(messages)
        inbox.received += count
        if inbox.target is None:
            inbox.bound()
