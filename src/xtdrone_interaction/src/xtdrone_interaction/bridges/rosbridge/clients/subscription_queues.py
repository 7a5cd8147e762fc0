"""The messages of one subscription that wait for their client, without ROS and without a socket."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")

MAX_BYTES = 8_000_000
"""Bytes of messages that wait in a queue; a single message may be larger."""
UNTHROTTLED = 100
"""Messages that wait for a client that wants all of them and names no length."""


class SendQueue(Generic[T]):
    """Messages that wait until the client may have the next one; the oldest are dropped where they are too many.

    A client that wants few messages (``throttle_rate``), or takes them slowly, thus always gets the newest. One thread
    adds messages, another takes them.
    """

    def __init__(self, interval: float, length: int) -> None:
        """Initialise without messages.

        Args:
            interval: least time between two messages, s.
            length: messages that may wait; 0 for one with an interval, and ``UNTHROTTLED`` without.
        """
        self._lock = threading.Lock()
        self._waiting: deque[tuple[T, int]] = deque()
        self._bytes = 0
        self._free_at = float("-inf")
        self.resize(interval, length)

    def __len__(self) -> int:
        return len(self._waiting)

    def resize(self, interval: float, length: int) -> None:
        """Change interval and length, as in ``__init__``; the newest messages are kept."""
        with self._lock:
            self._interval = interval
            self._length = length or (1 if interval > 0.0 else UNTHROTTLED)
            self._drop()

    def add(self, message: T, size: int) -> None:
        """Add a message of some bytes."""
        with self._lock:
            self._waiting.append((message, size))
            self._bytes += size
            self._drop()

    def delay(self, now: float) -> float:
        """Return the time until the next message may be sent, s; 0 for now.

        Args:
            now: monotonic time, s.
        """
        return max(0.0, self._free_at - now)

    def pop(self, now: float) -> T:
        """Return the oldest waiting message, which is then sent.

        Raises:
            IndexError: none is waiting.
        """
        with self._lock:
            message, size = self._waiting.popleft()
            self._bytes -= size
            self._free_at = now + self._interval
            return message

    def _drop(self) -> None:
        while len(self._waiting) > self._length or (len(self._waiting) > 1 and self._bytes > MAX_BYTES):
            self._bytes -= self._waiting.popleft()[1]
