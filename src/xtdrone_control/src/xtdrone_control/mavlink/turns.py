"""Turns: which client's datagrams are acted on next, and how many while a simulated step lasts.

The clients whose datagrams the lockstep counts are not in here: they are part of the flight, and all that they send is
acted on at once. Everything else waits in a queue of its sender's, and the senders take turns.

A datagram costs 1, 1 more for each 128 bytes, 1 for each message that answers it, and 16 for each that it leads to
for others: texts, events, changed parameters, each of which the MAVROS layer has to log or to pass on. All clients
together earn ``STEP_EARNINGS`` and, for each vehicle, ``VEHICLE_EARNINGS`` in a simulated step, and may save up to
``SAVINGS``; while simulated time stands still they have ``SAVINGS`` in each round, because nothing else is held up. A
client earns a little of its own besides, which it spends when the common credit is used up: a client that asks little
is served, whatever the others send.

So a flood costs a bounded number of frames a step from whichever client, port and address it comes. What exceeds it
waits, and beyond the length of a queue it is dropped, as a full socket buffer would.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from typing import Generic, TypeVar

STEP_US = 4000
STEP_EARNINGS = 4.0
VEHICLE_EARNINGS = 0.25  # a step
SAVINGS = 256.0
OWN_EARNINGS = 0.125  # a step: 31 datagrams a simulated second, as a joystick sends
OWN_SAVINGS = 8.0
_BYTES_A_CREDIT = 128
_FOR_OTHERS = 16

_CLIENT_DATAGRAMS = 256  # in a client's queue: a transfer in one go, or a tick's setpoints many times over
_CLIENT_BYTES = 1 << 16
_STRANGER_DATAGRAMS = 64  # what a client may send in one go before the first of it is acted on
_STRANGERS = 16  # on one port


class Purse:
    """Credit that is earned by simulated time.

    Attributes:
        left: what may still be spent; below 0 after something that cost more than there was.
    """

    __slots__ = ("_earned_us", "_most", "_rate", "left")

    def __init__(self, earnings: float, most: float, now_us: int = 0) -> None:
        """Begin with a full purse.

        Args:
            earnings: credit a simulated step.
            most: credit that can be saved.
            now_us: simulated time, microseconds.
        """
        self._rate = earnings / STEP_US
        self._most = most
        self._earned_us = now_us
        self.left = most

    def earn(self, now_us: int) -> bool:
        """Add what was earned by ``now_us``; return whether time has moved since the last call."""
        elapsed, self._earned_us = now_us - self._earned_us, now_us
        if elapsed > 0:
            self.left = min(self.left + elapsed * self._rate, self._most)
        return elapsed != 0

    def fill(self) -> None:
        """Fill the purse."""
        self.left = self._most


def cost(size: int, answers: int, others: int) -> int:
    """Return what a datagram costs.

    Args:
        size: its bytes.
        answers: messages to its sender that it has led to.
        others: messages to other clients, or to all, that it has led to.
    """
    return 1 + size // _BYTES_A_CREDIT + answers + _FOR_OTHERS * others


Place = TypeVar("Place", bound=Hashable)


class Turns(Generic[Place]):
    """Queues of datagrams by place (a port) and sender, and the order in which the senders are served."""

    def __init__(self) -> None:
        """Start with empty queues."""
        self._queues: dict[tuple[Place, tuple[str, int]], deque[bytes]] = {}
        self._sizes: dict[tuple[Place, tuple[str, int]], int] = {}
        self._strangers: dict[Place, set[tuple[str, int]]] = {}

    def __len__(self) -> int:
        """Return the number of senders that wait."""
        return len(self._queues)

    def put(self, place: Place, sender: tuple[str, int], datagram: bytes, *, known: bool) -> bool:
        """Queue a datagram.

        Args:
            place: where it has arrived.
            sender: its sender's address.
            datagram: its content.
            known: whether the sender is a client there; a stranger's queue is short.

        Returns:
            False if there was no room for it: it is dropped.
        """
        key = (place, sender)
        queue = self._queues.get(key)
        if queue is None:
            if not known and not self._let_in(place, sender):
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

    def _let_in(self, place: Place, sender: tuple[str, int]) -> bool:
        strangers = self._strangers.setdefault(place, set())
        if len(strangers) >= _STRANGERS:
            return False
        strangers.add(sender)
        return True

    def waiting(self) -> list[tuple[Place, tuple[str, int]]]:
        """Return place and address of all senders that wait, the next to be served first."""
        return list(self._queues)

    def waits(self, place: Place, sender: tuple[str, int]) -> bool:
        """Return whether a sender waits."""
        return (place, sender) in self._queues

    def take(self, place: Place, sender: tuple[str, int]) -> bytes:
        """Return the oldest datagram of a sender that waits, who goes to the end of the line."""
        key = (place, sender)
        queue = self._queues.pop(key)
        datagram = queue.popleft()
        if queue:
            self._queues[key] = queue
            self._sizes[key] -= len(datagram)
        else:
            del self._sizes[key]
            self._strangers.get(place, set()).discard(sender)
        return datagram
