"""Commands that wait for their COMMAND_ACK.

Calls block in service threads; acks arrive in the receiver thread. Timeouts are wall time: they detect an autopilot
that does not answer, independently of simulated time.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.codec import decoder

ACK_LIMIT = 5.0  # s, as MAVROS's ACK_TIMEOUT
RESENDS = 3

_decode_ack = decoder("COMMAND_ACK")


class _Waiting:
    """A sent command whose ack is pending."""

    def __init__(self, limit: float) -> None:
        self.done = threading.Event()
        self.result: int | None = None
        self.in_progress = False
        self.expires = time.monotonic() + limit


class AwaitedCommands:
    """Pending commands of one autopilot; acks carry no sequence number and go to the oldest command of their kind."""

    def __init__(
        self,
        send: Callable[[Any], None],
        meanwhile: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        """Prepare the commands.

        Args:
            send: sends a message.
            meanwhile: returns a context manager that is held while waiting for an ack.
        """
        self._send = send
        self._meanwhile = meanwhile
        self._lock = threading.Lock()
        self._turns: defaultdict[int, threading.Lock] = defaultdict(threading.Lock)
        self._waiting: defaultdict[int, deque[_Waiting]] = defaultdict(deque)

    def call(
        self, command: int, build: Callable[[int], Any], limit: float = ACK_LIMIT, resends: int = RESENDS
    ) -> int | None:
        """Send a command and return the MAV_RESULT of its ack, or None without an ack.

        Args:
            command: MAV_CMD number; calls with the same number run one at a time.
            build: returns the message for attempt 0, 1, ...
            limit: timeout of all attempts together, seconds of wall time.
            resends: number of repetitions, at equal intervals; none after an "in progress" ack.
        """
        with self._lock:
            turn = self._turns[command]
        with turn:
            waiting = self._add(command, limit)
            try:
                for attempt in range(1 + resends):
                    if not waiting.in_progress:
                        self._send(build(attempt))
                    with self._meanwhile():
                        done = waiting.done.wait(limit / (1 + resends))
                    if done:
                        break
                return waiting.result
            finally:
                self._remove(command, waiting)

    def send(self, command: int, message: Any) -> None:
        """Send a command without waiting, but register its ack so that a later call does not mistake it for its own."""
        self._add(command, ACK_LIMIT)
        self._send(message)

    def on_ack(self, frame: bytes) -> None:
        """Handle a COMMAND_ACK frame; called by the receiver thread."""
        ack = _decode_ack(frame)
        with self._lock:
            waiting = self._oldest(ack.command)
            if waiting is None:
                return
            if ack.result == mavlink.MAV_RESULT_IN_PROGRESS:
                waiting.in_progress = True
                return
            self._waiting[ack.command].popleft()
        waiting.result = ack.result
        waiting.done.set()

    def _oldest(self, command: int) -> _Waiting | None:
        queue = self._waiting[command]
        now = time.monotonic()
        while queue and queue[0].expires < now:
            queue.popleft()
        return queue[0] if queue else None

    def _add(self, command: int, limit: float) -> _Waiting:
        waiting = _Waiting(limit)
        with self._lock:
            self._oldest(command)  # drops expired commands
            self._waiting[command].append(waiting)
        return waiting

    def _remove(self, command: int, waiting: _Waiting) -> None:
        with self._lock:
            if waiting in self._waiting[command]:
                self._waiting[command].remove(waiting)
