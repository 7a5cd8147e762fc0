"""Rate limit of received datagrams: which client's datagram is handled next, and how many in a simulated step.

Lockstep participants are exempt: their datagrams are part of the flight and are handled on arrival. Every other sender
has a queue, and the queues are served round-robin.

A datagram costs 1, plus 1 for each 128 bytes, 1 for each message in reply, and 16 for each message sent to other
clients because of it (texts, events, changed parameters), because the MAVROS layer logs or republishes each of those.
In each simulated step all clients together receive ``STEP_CREDIT`` plus ``VEHICLE_CREDIT`` for each vehicle; they can
save up to ``MAX_CREDIT``. While simulated time stands still, they have ``MAX_CREDIT`` in each round, because handling
their datagrams then delays nothing. Each client also has a small credit that it spends once the shared credit is used
up, so a client with few requests is served regardless of the load from others.

A flood therefore costs a bounded number of frames in a step, from whichever client, port and address it comes. Excess
datagrams wait; those beyond the length of a queue are dropped, as by a full socket buffer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from typing import Generic, TypeVar

STEP_US = 4000
STEP_CREDIT = 4.0
VEHICLE_CREDIT = 0.25  # in a step
MAX_CREDIT = 256.0
CLIENT_CREDIT = 0.125  # in a step: 31 datagrams in a simulated second, the rate of a joystick
MAX_CLIENT_CREDIT = 8.0
_BYTES_PER_CREDIT = 128
_COST_TO_OTHERS = 16

_CLIENT_DATAGRAMS = 256  # in a client's queue: a burst of a transfer, or many times the setpoints of a tick
_CLIENT_BYTES = 1 << 16
_STRANGER_DATAGRAMS = 64  # burst of a new client before its first datagram is handled
_STRANGERS = 16  # on one port


class Credit:
    """Credit that accrues with simulated time.

    Attributes:
        left: remaining credit; negative after a datagram that cost more than was left.
    """

    __slots__ = ("_accrued_us", "_most", "_rate", "left")

    def __init__(self, per_step: float, most: float, now_us: int = 0) -> None:
        """Start with the largest credit.

        Args:
            per_step: credit added in a simulated step.
            most: largest credit that can be saved.
            now_us: simulated time, microseconds.
        """
        self.set_rate(per_step)
        self._most = most
        self._accrued_us = now_us
        self.left = most

    def set_rate(self, per_step: float) -> None:
        """Change the credit added in a simulated step."""
        self._rate = per_step / STEP_US

    def accrue(self, now_us: int) -> bool:
        """Add the credit accrued until ``now_us``; return whether time has moved since the last call."""
        elapsed, self._accrued_us = now_us - self._accrued_us, now_us
        if elapsed > 0:
            self.left = min(self.left + elapsed * self._rate, self._most)
        return elapsed != 0

    def fill(self) -> None:
        """Restore the largest credit."""
        self.left = self._most


def cost(size: int, replies: int, others: int) -> int:
    """Return the credit that a datagram costs.

    Args:
        size: bytes of the datagram.
        replies: messages sent to its sender because of it.
        others: messages sent to other clients, or to all, because of it.
    """
    return 1 + size // _BYTES_PER_CREDIT + replies + _COST_TO_OTHERS * others


PortKey = TypeVar("PortKey", bound=Hashable)


class DatagramQueues(Generic[PortKey]):
    """Queues of datagrams by port and sender, in the order in which the senders are served."""

    def __init__(self) -> None:
        """Start with empty queues."""
        self._queues: dict[tuple[PortKey, tuple[str, int]], deque[bytes]] = {}
        self._sizes: dict[tuple[PortKey, tuple[str, int]], int] = {}
        self._strangers: dict[PortKey, set[tuple[str, int]]] = {}

    def __len__(self) -> int:
        """Return the number of senders with queued datagrams."""
        return len(self._queues)

    def put(self, port: PortKey, sender: tuple[str, int], datagram: bytes, *, known: bool) -> bool:
        """Queue a datagram.

        Args:
            port: port that received it.
            sender: address of its sender.
            datagram: its content.
            known: whether the sender is a client of the port; the queue of an unknown sender is short.

        Returns:
            False if the queue is full and the datagram is dropped.
        """
        key = (port, sender)
        queue = self._queues.get(key)
        if queue is None:
            if not known and not self._admit(port, sender):
                return False
            self._queues[key] = deque([datagram])
            self._sizes[key] = len(datagram)
            return True
        size = self._sizes[key] + len(datagram)
        if len(queue) >= (_CLIENT_DATAGRAMS if known else _STRANGER_DATAGRAMS) or size > _CLIENT_BYTES:
            return False
        queue.append(datagram)
        self._sizes[key] = size
        return True

    def _admit(self, port: PortKey, sender: tuple[str, int]) -> bool:
        strangers = self._strangers.setdefault(port, set())
        if len(strangers) >= _STRANGERS:
            return False
        strangers.add(sender)
        return True

    def drop(self, port: PortKey) -> None:
        """Drop all datagrams of a port that is closed."""
        for key in [key for key in self._queues if key[0] is port]:
            del self._queues[key], self._sizes[key]
        self._strangers.pop(port, None)

    def waiting(self) -> list[tuple[PortKey, tuple[str, int]]]:
        """Return port and address of all senders with queued datagrams, the next to be served first."""
        return list(self._queues)

    def is_waiting(self, port: PortKey, sender: tuple[str, int]) -> bool:
        """Return whether a sender has queued datagrams."""
        return (port, sender) in self._queues

    def pop(self, port: PortKey, sender: tuple[str, int]) -> bytes:
        """Return the oldest datagram of a waiting sender and move the sender to the end of the order."""
        key = (port, sender)
        queue = self._queues.pop(key)
        datagram = queue.popleft()
        if queue:
            self._queues[key] = queue
            self._sizes[key] -= len(datagram)
        else:
            del self._sizes[key]
            self._strangers.get(port, set()).discard(sender)
        return datagram
