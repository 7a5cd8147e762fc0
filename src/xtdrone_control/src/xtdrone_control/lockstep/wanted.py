"""The topic connections that the participants' declarations need, and which of them are not made yet.

By topic and by name, so that what one participant declares costs as much as it has to do with, however many others
there are.
"""

from __future__ import annotations

from collections.abc import Iterator

from .frames import Declaration
from .participant import Pair

_NOTHING = Declaration({}, {})


class Topics:
    """What every participant publishes and subscribes to."""

    def __init__(self) -> None:
        """Starts with nothing declared."""
        self._declared: dict[str, Declaration] = {}
        self._publishers: dict[str, dict[str, str]] = {}  # topic to names to types
        self._subscribers: dict[str, dict[str, str]] = {}
        self._clashes: dict[str, set[Pair]] = {}  # by name, those that have been told

    def declare(self, name: str, declaration: Declaration) -> None:
        """Notes all topics of a participant, in place of those that it had before."""
        self._forget_topics(name)
        self._declared[name] = declaration
        for topic, kind in declaration.publications.items():
            self._publishers.setdefault(topic, {})[name] = kind
        for topic, kind in declaration.subscriptions.items():
            self._subscribers.setdefault(topic, {})[name] = kind

    def withdraw(self, name: str) -> None:
        """Forgets a participant."""
        self._forget_topics(name)
        self._declared.pop(name, None)
        for pair in self._clashes.pop(name, ()):
            for other in pair[1:]:
                if other in self._clashes:
                    self._clashes[other].discard(pair)
                    if not self._clashes[other]:
                        del self._clashes[other]

    def publishes(self, name: str, topic: str) -> bool:
        """Says whether a participant declares that it publishes a topic."""
        return topic in self._declared.get(name, _NOTHING).publications

    def subscribes(self, name: str, topic: str) -> bool:
        """Says whether a participant declares that it subscribes to a topic."""
        return topic in self._declared.get(name, _NOTHING).subscriptions

    def pairs(self, name: str) -> Iterator[tuple[Pair, str, str]]:
        """Yields the connections that a participant's topics have in common with all others', and with each other.

        Each comes with the publisher's and the subscriber's type; one of a participant with itself comes twice.
        """
        declared = self._declared.get(name, _NOTHING)
        for topic, sent in declared.publications.items():
            for subscriber, read in self._subscribers.get(topic, {}).items():
                yield (topic, name, subscriber), sent, read
        for topic, read in declared.subscriptions.items():
            for publisher, sent in self._publishers.get(topic, {}).items():
                yield (topic, publisher, name), sent, read

    def is_new_clash(self, pair: Pair) -> bool:
        """Says whether types that differ have not been asked about before, while both participants have been there."""
        _, publisher, subscriber = pair
        told = self._clashes.setdefault(publisher, set())
        if pair in told:
            return False
        told.add(pair)
        self._clashes.setdefault(subscriber, set()).add(pair)
        return True

    def _forget_topics(self, name: str) -> None:
        before = self._declared.get(name, _NOTHING)
        for table, topics in ((self._publishers, before.publications), (self._subscribers, before.subscriptions)):
            for topic in topics:
                table[topic].pop(name, None)
                if not table[topic]:
                    del table[topic]


class Missing:
    """Connections that should exist and do not, each with the wall time at which the world no longer waits for it."""

    def __init__(self) -> None:
        """Starts with none."""
        self._limits: dict[Pair, float] = {}
        self._of: dict[str, dict[Pair, None]] = {}

    def __len__(self) -> int:
        """Returns how many there are."""
        return len(self._limits)

    def __iter__(self) -> Iterator[Pair]:
        """Yields them in the order in which they became missing."""
        return iter(self._limits)

    def of(self, name: str) -> list[Pair]:
        """Returns those of which a participant is one end."""
        return list(self._of.get(name, ()))

    def add(self, pair: Pair, limit: float) -> None:
        """Adds one, with a monotonic time in s; one that is missing already keeps its limit."""
        if pair in self._limits:
            return
        self._limits[pair] = limit
        for name in pair[1:]:
            self._of.setdefault(name, {})[pair] = None

    def discard(self, pair: Pair) -> None:
        """Removes one, if it is there."""
        if self._limits.pop(pair, None) is None:
            return
        for name in set(pair[1:]):
            del self._of[name][pair]
            if not self._of[name]:
                del self._of[name]

    def postpone(self, seconds: float) -> None:
        """Moves every limit by some seconds."""
        for pair in self._limits:
            self._limits[pair] += seconds

    def expire(self, now: float) -> list[Pair]:
        """Removes and returns those whose limit has passed at `now`."""
        over = [pair for pair, limit in self._limits.items() if now >= limit]
        for pair in over:
            self.discard(pair)
        return over
