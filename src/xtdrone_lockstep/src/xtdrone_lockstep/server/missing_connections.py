"""Topic connections required by the participants' declarations, and those not made yet.

Indexed by topic and by name, so that the cost of a declaration does not grow with the number of unrelated participants.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from .frame_checks import Declaration
from .participant import Pair

ASK_PERIOD = 2.0
"""Wall seconds without a connection after which its subscriber asks the master again, and between such questions."""
_NOTHING = Declaration({}, {})


class TopicTable:
    """The topics that each participant publishes and subscribes to."""

    def __init__(self) -> None:
        self._declared: dict[str, Declaration] = {}
        self._publishers: dict[str, dict[str, str]] = {}  # type by name, by topic
        self._subscribers: dict[str, dict[str, str]] = {}
        self._clashes: dict[str, set[Pair]] = {}  # reported type mismatches by name

    def declare(self, name: str, declaration: Declaration) -> None:
        """Replace all topics of a participant."""
        self._remove_topics(name)
        self._declared[name] = declaration
        for topic, kind in declaration.publications.items():
            self._publishers.setdefault(topic, {})[name] = kind
        for topic, kind in declaration.subscriptions.items():
            self._subscribers.setdefault(topic, {})[name] = kind

    def remove(self, name: str) -> None:
        """Remove a participant."""
        self._remove_topics(name)
        self._declared.pop(name, None)
        for pair in self._clashes.pop(name, ()):
            for other in pair[1:]:
                if other in self._clashes:
                    self._clashes[other].discard(pair)
                    if not self._clashes[other]:
                        del self._clashes[other]

    def publishes(self, name: str, topic: str) -> bool:
        """Return whether a participant declares ``topic`` as published."""
        return topic in self._declared.get(name, _NOTHING).publications

    def subscribes(self, name: str, topic: str) -> bool:
        """Return whether a participant declares ``topic`` as subscribed to."""
        return topic in self._declared.get(name, _NOTHING).subscriptions

    def pairs(self, name: str) -> Iterator[tuple[Pair, str, str]]:
        """Yield the connections between a participant's topics and those of all participants, itself included.

        Each is yielded with the publisher's and the subscriber's type; a connection of the participant to itself is
        yielded twice.
        """
        declared = self._declared.get(name, _NOTHING)
        for topic, sent in declared.publications.items():
            for subscriber, read in self._subscribers.get(topic, {}).items():
                yield (topic, name, subscriber), sent, read
        for topic, read in declared.subscriptions.items():
            for publisher, sent in self._publishers.get(topic, {}).items():
                yield (topic, publisher, name), sent, read

    def is_new_clash(self, pair: Pair) -> bool:
        """Record a type mismatch; return whether it is the first one of this pair while both participants are there."""
        _, publisher, subscriber = pair
        reported = self._clashes.setdefault(publisher, set())
        if pair in reported:
            return False
        reported.add(pair)
        self._clashes.setdefault(subscriber, set()).add(pair)
        return True

    def _remove_topics(self, name: str) -> None:
        before = self._declared.get(name, _NOTHING)
        for table, topics in ((self._publishers, before.publications), (self._subscribers, before.subscriptions)):
            for topic in topics:
                table[topic].pop(name, None)
                if not table[topic]:
                    del table[topic]


@dataclass(slots=True)
class _Wait:
    """The wait for one connection.

    Attributes:
        until: Monotonic time in seconds at which it ends.
        ask_at: Monotonic time in seconds at which the subscriber is to ask the master again.
        asked: How often it has been told to do so.
    """

    until: float
    ask_at: float
    asked: int = 0


class MissingConnections:
    """Required connections that are not made yet, each with the wall time until which the simulation waits for it."""

    def __init__(self) -> None:
        self._waits: dict[Pair, _Wait] = {}
        self._of: dict[str, dict[Pair, None]] = {}

    def __len__(self) -> int:
        """Return the number of missing connections."""
        return len(self._waits)

    def __iter__(self) -> Iterator[Pair]:
        """Yield them in the order in which they were added."""
        return iter(self._waits)

    def of(self, name: str) -> list[Pair]:
        """Return the missing connections from or to a participant."""
        return list(self._of.get(name, ()))

    def add(self, pair: Pair, now: float, limit: float) -> None:
        """Add a connection that is missing from ``now`` on; one already missing keeps its times.

        Args:
            pair: The connection.
            now: Monotonic time in seconds.
            limit: Longest wait in wall seconds.
        """
        if pair in self._waits:
            return
        self._waits[pair] = _Wait(now + limit, now + ASK_PERIOD)
        for name in pair[1:]:
            self._of.setdefault(name, {})[pair] = None

    def discard(self, pair: Pair) -> None:
        """Remove a connection if it is missing."""
        if self._waits.pop(pair, None) is None:
            return
        for name in set(pair[1:]):
            del self._of[name][pair]
            if not self._of[name]:
                del self._of[name]

    def postpone(self, seconds: float) -> None:
        """Move all times."""
        for wait in self._waits.values():
            wait.until += seconds
            wait.ask_at += seconds

    def take_due(self, now: float) -> list[Pair]:
        """Return the connections for which the master is to be asked again at ``now``, at most once per period."""
        due = [pair for pair, wait in self._waits.items() if now >= wait.ask_at]
        for pair in due:
            wait = self._waits[pair]
            wait.ask_at = now + ASK_PERIOD
            wait.asked += 1
        return due

    def expire(self, now: float) -> list[tuple[Pair, int]]:
        """Remove the connections whose wait has ended at ``now``; return each with the number of times asked."""
        expired = [(pair, wait.asked) for pair, wait in self._waits.items() if now >= wait.until]
        for pair, _ in expired:
            self.discard(pair)
        return expired
