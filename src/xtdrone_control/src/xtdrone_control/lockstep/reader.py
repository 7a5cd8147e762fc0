"""Reads a participant's topic connections in its own thread, in place of a thread of rospy's for each.

rospy makes a connection (header exchange, retries) and then hands it over. A connection from another participant is
read when a TICK says that there is something in it; until then the kernel, and behind it the publisher, holds what was
sent. A connection from a publisher that is no participant is read whenever something comes while the node waits.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import rospy.core

FOREIGN_QUEUE = 1000
"""Messages kept of a publisher that is no participant, when the subscriber names no queue size."""
LONGEST_RECEIVE = 1 << 20
"""Most bytes asked for at a time, when the rest of a message is longer than the subscriber's buffer size."""
KERNEL_BUFFER = 1 << 20
"""Receive buffer in bytes asked of the kernel, which may grant less: what comes between turns lies there."""

_LENGTH = struct.Struct("<I")
_QUIET = select.EPOLLRDHUP
_EAGER = select.EPOLLIN | select.EPOLLRDHUP


class Inbox:
    """The messages of one connection, in the order of sending.

    Attributes:
        publisher: The publisher's name.
        messages: Received and not yet dispatched: serialised if they came by a feed, else message objects.
        received: Messages received since the connection was made.
        dropped: Of these, discarded because a foreign publisher's queue was full.
        taken: Of these, dispatched or discarded by the node's thread; written by it only.
        target: How many may be dispatched by now; None if the publisher is no participant.
        given_up: Messages that were counted by the publisher and never came.
        closed: True when no more will come.
        lost: True when the server has said that the channel is no more.
        latched: True if the publisher latches.
        latch: The last message dispatched, kept if `latched`.
        most_kept: Of a foreign publisher's messages at most so many are kept.
        feed: Reads the connection; None before it is handed over, or if a thread of rospy's reads it.
        decode: Makes a message object of a serialised message; returns None if that fails.
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
        """Starts empty, as a foreign publisher's."""
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
        self.feed: Feed | None = None
        self.decode: Callable[[bytes], Any] | None = None

    def lacking(self) -> int:
        """Returns how many messages that must be here have not come yet."""
        if self.target is None:
            return 0
        return max(0, self.target - self.given_up - self.received)

    def fetch(self) -> bool:
        """Reads until nothing is lacking, and no longer than the connection has something at hand.

        Returns:
            True if nothing is lacking.
        """
        while self.lacking():
            if self.feed is None or not self.feed.pull():
                return False
        return True

    def bound(self) -> None:
        """Discards what is beyond `most_kept` of a foreign publisher's messages, the oldest first."""
        if self.target is not None:
            return
        for _ in range(len(self.messages) - self.most_kept):
            try:
                self.messages.popleft()
            except IndexError:  # the node's thread was faster
                return
            self.dropped += 1

    def discard(self, count: int) -> None:
        """Drops what is not dispatched yet of the first ``count`` messages, unless they are latched: those hold on."""
        if self.latched:
            return
        for _ in range(min(len(self.messages), count - self.given_up - self.taken - self.dropped)):
            self.messages.popleft()
            self.taken += 1

    def take(self, most_foreign: int) -> Iterator[Any]:
        """Yields and removes the messages whose tick it is.

        Args:
            most_foreign: Of a foreign publisher's messages at most so many, the newest.
        """
        if self.target is None:
            surplus = max(0, len(self.messages) - most_foreign)
            ready = len(self.messages)
        else:
            surplus = 0
            ready = self.target - self.given_up - self.taken - self.dropped
        for index in range(ready):
            try:
                message = self.messages.popleft()
            except IndexError:  # given up waiting for it, or discarded by rospy's thread just now
                return
            self.taken += 1
            if index < surplus:
                continue
            if self.decode is not None:
                message = self.decode(message)
                if message is None:
                    continue
            if self.latched:
                self.latch = message
            yield message


class Feed:
    """Cuts the bytes of one connection into messages and puts them, still serialised, into its inbox.

    All in the node's own thread but `close`, which rospy calls in any, and the start.
    """

    def __init__(self, connection: Any, inbox: Inbox) -> None:
        """Takes a connection over.

        Args:
            connection: rospy's TCPROSTransport, connected.
            inbox: Takes the messages.

        Raises:
            AttributeError: The connection is closed.
        """
        self.inbox = inbox
        self.sock: socket.socket = connection.socket
        self._connection = connection
        self._close_connection = connection.close
        # Reentrant: a signal handler, in which rospy closes the topics, may interrupt the node's thread in here.
        self._lock = threading.RLock()
        self._rest = bytearray()
        self._usual_size = self._receive_size = connection.protocol.buff_size
        with contextlib.suppress(OSError):
            if self.sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < KERNEL_BUFFER:
                self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, KERNEL_BUFFER)
        # What was received along with the connection's header.
        head = connection.read_buff.getvalue()[: connection.read_buff.tell()]
        connection.close = self.close
        if head:
            self._cut(head)

    def pull(self) -> bool:
        """Reads once, without waiting; closes the connection if the publisher has.

        Returns:
            True if something was read.
        """
        if self._pull():
            return True
        if self.inbox.closed:
            self._close_connection()
        return False

    def close(self) -> None:
        """Closes the connection after having read what has come; in place of the transport's `close`."""
        if not rospy.core.is_shutdown_requested():
            while not self.inbox.closed and self._pull():
                pass
        self.inbox.closed = True
        self._close_connection()

    def _pull(self) -> bool:
        with self._lock:
            try:
                data = self.sock.recv(self._receive_size, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return False
            except OSError:  # reset by the publisher, or closed in another thread
                data = b""
            if not data:
                self.inbox.closed = True
                return False
            self._cut(data)
            return True

    def _cut(self, data: bytes) -> None:
        connection, inbox = self._connection, self.inbox
        connection.stat_bytes += len(data)
        size = len(data)
        if not self._rest and size >= 4 and _LENGTH.unpack_from(data)[0] + 4 == size:
            # One whole message, as mostly.
            inbox.messages.append(data[4:])
            count = 1
        else:
            count = self._cut_many(data)
        connection.stat_num_msg += count
        inbox.received += count
        if inbox.target is None:
            inbox.bound()

    def _cut_many(self, data: bytes) -> int:
        rest = self._rest
        rest += data
        start, count = 0, 0
        needed = 0
        while len(rest) - start >= 4:
            end = start + 4 + _LENGTH.unpack_from(rest, start)[0]
            if end > len(rest):
                needed = end - len(rest)
                break
            self.inbox.messages.append(bytes(rest[start + 4 : end]))
            start = end
            count += 1
        del rest[:start]
        self._receive_size = max(self._usual_size, min(needed, LONGEST_RECEIVE))
        return count


class Reader:
    """Everything that a participant's main thread waits for: its connections, the simulator, and a wake-up.

    Attributes:
        active: True in a participant; else rospy's own threads read.
    """

    def __init__(self) -> None:
        """Starts inactive."""
        self.active = False
        self._handlers: dict[int, Callable[[], Any]] = {}
        self._feeds: dict[int, Feed] = {}
        self._handed_over: deque[Feed] = deque()

    def activate(self) -> None:
        """Takes connections from now on."""
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._epoll = select.epoll()
        self.watch(self._wake_read, self._woken)
        self.active = True

    def wake(self) -> None:
        """Ends a wait in the main thread; called in any thread, also in a signal handler."""
        if self.active:
            with contextlib.suppress(BlockingIOError):  # full of wake-ups already
                os.write(self._wake_write, b"x")

    def watch(self, descriptor: int, handler: Callable[[], Any]) -> None:
        """Calls `handler` in `wait` whenever a descriptor is readable; it must read."""
        self._epoll.register(descriptor, select.EPOLLIN)
        self._handlers[descriptor] = handler

    def hand_over(self, feed: Feed) -> None:
        """Gives a connection to the main thread; called in rospy's thread that has made it."""
        self._handed_over.append(feed)
        self.wake()

    def wait(self, timeout: float) -> None:
        """Waits until something comes, and handles what has come.

        Args:
            timeout: Longest wait in wall seconds.
        """
        for descriptor, _ in self._epoll.poll(timeout):
            handler = self._handlers.get(descriptor)
            if handler is not None:
                handler()
                continue
            feed = self._feeds.get(descriptor)
            if feed is not None and not feed.pull() and feed.inbox.closed:
                del self._feeds[descriptor]

    def wait_whole(self, seconds: float) -> None:
        """Handles what comes for so long, in wall seconds, or until the node is shut down."""
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0.0 and not rospy.core.is_shutdown_requested():
            self.wait(remaining)

    def await_messages(self, inboxes: Iterable[Inbox], limit: float) -> list[Inbox]:
        """Reads until nothing is lacking in the inboxes that are open, or the node is shut down.

        Args:
            inboxes: To be filled.
            limit: Monotonic time at which it gives up.

        Returns:
            The inboxes that are open and still lack messages.
        """
        eager: set[Feed] = set()
        while True:
            lacking = [inbox for inbox in inboxes if not inbox.fetch() and not inbox.closed]
            remaining = limit - time.monotonic()
            if not lacking or remaining <= 0.0 or rospy.core.is_shutdown_requested():
                break
            for feed in {inbox.feed for inbox in lacking if inbox.feed is not None} - eager:
                self._listen(feed, _EAGER)
                eager.add(feed)
            self.wait(remaining)
        for feed in eager:
            self._listen(feed, _QUIET)
        return lacking

    def count(self, inbox: Inbox) -> None:
        """Takes an inbox's publisher for a participant from now on: its connection is read at TICK."""
        inbox.target = 0
        if inbox.feed is not None:
            self._listen(inbox.feed, _QUIET)

    def _listen(self, feed: Feed, mask: int) -> None:
        # A connection that was closed has left the set by itself.
        with contextlib.suppress(OSError, ValueError):
            self._epoll.modify(feed.sock.fileno(), mask)

    def _woken(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._wake_read, 4096)
        while self._handed_over:
            feed = self._handed_over.popleft()
            feed.inbox.feed = feed
            # A publisher's end, or a close in another thread, is noticed in the set or was before: then there is none.
            with contextlib.suppress(OSError, ValueError):
                descriptor = feed.sock.fileno()
                self._epoll.register(descriptor, _EAGER if feed.inbox.target is None else _QUIET)
                self._feeds[descriptor] = feed
