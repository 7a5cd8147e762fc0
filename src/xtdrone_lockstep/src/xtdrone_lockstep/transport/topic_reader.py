"""Reads a participant's topic connections in its own thread, instead of one rospy thread per connection.

rospy makes a connection (header exchange, retries) and hands it over here. A connection from another participant is
read when a TICK reports messages on it; until then they stay in the kernel's buffers, and beyond these with the
publisher. A connection from a publisher that is not a participant is read whenever data arrives while the node waits.
"""

from __future__ import annotations

import contextlib
import os
import select
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import rospy.core
from xtdrone_native import lockstep_io

from .inbox import Inbox, TopicFeed

_QUIET = select.EPOLLRDHUP
_EAGER = select.EPOLLIN | select.EPOLLRDHUP


class Reader:
    """Waits in a participant's main thread for its topic connections, for the simulator, and for wake-ups.

    Attributes:
        active: Whether it reads the connections; otherwise rospy's threads do.
        inboxes_changed: Whether an inbox was created or removed since the node has cleared this.
    """

    def __init__(self) -> None:
        """Create an inactive reader."""
        self.active = False
        self.inboxes_changed = False
        self._handlers: dict[int, Callable[[], Any]] = {}
        self._feeds: dict[int, TopicFeed] = {}
        self._handed_over: deque[TopicFeed] = deque()

    def activate(self) -> None:
        """Read all connections made from now on."""
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._epoll = select.epoll()
        self.watch(self._wake_read, self._woken)
        self.active = True

    def wake(self) -> None:
        """End a wait in the main thread; may be called in any thread and in signal handlers."""
        if self.active:
            with contextlib.suppress(BlockingIOError):  # the pipe is full of wake-ups
                os.write(self._wake_write, b"x")

    def watch(self, descriptor: int, handler: Callable[[], Any]) -> None:
        """Call ``handler``, which must read, in ``wait`` whenever a file descriptor is readable."""
        self._epoll.register(descriptor, select.EPOLLIN)
        self._handlers[descriptor] = handler

    def hand_over(self, feed: TopicFeed) -> None:
        """Pass a connection to the main thread; called in the rospy thread that has made it."""
        self._handed_over.append(feed)
        self.wake()

    def wait(self, timeout: float) -> None:
        """Wait until data arrives, and handle it.

        Args:
            timeout: Longest wait in wall seconds.
        """
        self._handle([descriptor for descriptor, _ in self._epoll.poll(timeout)])

    def receive(
        self, descriptor: int, timeout: float, *, whole: bool
    ) -> bytes | tuple[int, int, dict[int, int], dict[int, int]] | None:
        """Wait until data arrives, and handle it unless it is from the simulator alone.

        Args:
            descriptor: The simulator's watched connection.
            timeout: Longest wait in wall seconds.
            whole: Whether its next byte is the first of a frame.

        Returns:
            The content of one TICK, or other bytes from the simulator, empty at the end of the connection; None if
            there was anything else to handle, or nothing.

        Raises:
            OSError: The connection to the simulator is broken.
        """
        return self.sort(lockstep_io.receive(self._epoll.fileno(), descriptor, timeout, whole))

    def sort(
        self, received: bytes | tuple[int, int, dict[int, int], dict[int, int]] | list[int]
    ) -> bytes | tuple[int, int, dict[int, int], dict[int, int]] | None:
        """Handle the result of a wait, unless it is data from the simulator alone; see ``receive``.

        Args:
            received: The result of ``lockstep_io``: data, or the descriptors that are ready.
        """
        if not isinstance(received, list):
            return received
        self._handle(received)
        return None

    @property
    def descriptor(self) -> int:
        """Descriptor of the set in which an active reader waits."""
        return self._epoll.fileno()

    def _handle(self, descriptors: Iterable[int]) -> None:
        for descriptor in descriptors:
            handler = self._handlers.get(descriptor)
            if handler is not None:
                handler()
                continue
            feed = self._feeds.get(descriptor)
            if feed is not None and not feed.pull() and feed.inbox.closed:
                del self._feeds[descriptor]

    def wait_for(self, seconds: float) -> None:
        """Handle data for ``seconds`` of wall time, or until the node is shut down."""
        end = time.monotonic() + seconds
        while (remaining := end - time.monotonic()) > 0.0 and not rospy.core.is_shutdown_requested():
            self.wait(remaining)

    def await_messages(self, inboxes: Iterable[Inbox], limit: float) -> list[Inbox]:
        """Read until no open inbox lacks messages, or the node is shut down.

        Args:
            inboxes: Inboxes to be filled.
            limit: Monotonic wall time in seconds at which to give up.

        Returns:
            The inboxes that are open and still lack messages.
        """
        eager: set[TopicFeed] = set()
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
        """Treat an inbox's publisher as a participant from now on: its connection is read at TICK only."""
        inbox.target = 0
        if inbox.feed is not None:
            self._listen(inbox.feed, _QUIET)

    def _listen(self, feed: TopicFeed, mask: int) -> None:
        # A closed connection has left the epoll set.
        with contextlib.suppress(OSError, ValueError):
            self._epoll.modify(feed.sock.fileno(), mask)

    def _woken(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._wake_read, 4096)
        while self._handed_over:
            feed = self._handed_over.popleft()
            feed.inbox.feed = feed
            # If the connection has been closed already, there is no descriptor to register.
            with contextlib.suppress(OSError, ValueError):
                descriptor = feed.sock.fileno()
                self._epoll.register(descriptor, _EAGER if feed.inbox.target is None else _QUIET)
                self._feeds[descriptor] = feed
