"""Topic connections required by the participants' declarations, and those not made yet.

Indexed by topic and by name, so that the cost of a declaration does not grow with the number of unrelated participants.
"""

from __future__ import annotations

from collections.abc import Iterator

from .frame_checks import Declaration
from .participant import Pair

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


class MissingConnections:
    """Required connections that are not made yet, each with the wall time until which the simulation waits for it."""

    def __init__(self) -> None:
        self._deadlines: dict[Pair, float] = {}
        self._of: dict[str, dict[Pair, None]] = {}

    def __len__(self) -> int:
        """Return the number of missing connections."""
        return len(self._deadlines)

    def __iter__(self) -> Iterator[Pair]:
        """Yield them in the order in which they were added."""
        return iter(self._deadlines)

    def of(self, name: str) -> list[Pair]:
        """Return the missing connections from or to a participant."""
        return list(self._of.get(name, ()))

    def add(self, pair: Pair, deadline: float) -> None:
        """Add a connection with its deadline in monotonic seconds; one already missing keeps its deadline."""
        if pair in self._deadlines:
            return
        self._deadlines[pair] = deadline
        for name in pair[1:]:
            self._of.setdefault(name, {})[pair] = None

    def discard(self, pair: Pair) -> None:
        """Remove a connection if it is missing."""
        if self._deadlines.pop(pair, None) is None:
            return
        for name in set(pair[1:]):
            del self._of[name][pair]
            if not self._of[name]:
                del self._of[name]

    def postpone(self, seconds: float) -> None:
        """Move all deadlines."""
        for pair in self._deadlines:
            self._deadlines[pair] += seconds

    def expire(self, now: float) -> list[Pair]:
        """Remove and return the connections whose deadline has passed at ``now``."""
        expired = [pair for pair, deadline in self._deadlines.items() if now >= deadline]
        for pair in expired:
            self.discard(pair)
        return expired
