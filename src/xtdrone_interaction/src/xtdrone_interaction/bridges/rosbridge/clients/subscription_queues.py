"""Queue of one subscription's messages for its client, without ROS or sockets."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")

MAX_BYTES = 8_000_000
"""Maximum bytes of messages in a queue; a single message may be larger."""
UNTHROTTLED = 100
"""Maximum queue length for a client that requests all messages and no length."""


class SendQueue(Generic[T]):
    """Queue of messages until the client may receive the next one; if it is full, the oldest are dropped.

    A client that throttles messages (``throttle_rate``), or reads slowly, thus always receives the newest. One thread
    adds messages, another removes them.
    """

    def __init__(self, interval: float, length: int) -> None:
        """Initialise without messages.

        Args:
            interval: minimum time between two messages, s.
            length: maximum queue length; 0: one message with an interval, ``UNTHROTTLED`` without.
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
        """Add a message of ``size`` bytes."""
        with self._lock:
            self._waiting.append((message, size))
            self._bytes += size
            self._drop()

    def delay(self, now: float) -> float:
        """Return the time until the next message may be sent, s; 0: now.

        Args:
            now: monotonic time, s.
        """
        return max(0.0, self._free_at - now)

    def pop(self, now: float) -> T:
        """Remove and return the oldest message.

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
