"""The ROS graph as seen by a bridge's clients: cached from the master, and filtered by patterns."""

from __future__ import annotations

import fnmatch
import threading
import time
from collections.abc import Callable, Sequence

from xtdrone_interaction.topics.discovery import UNKNOWN_TYPE, TopicGraph, read_topics

SHARE = 0.02
"""Share of the wall time spent on reading: the three thousand topics of thirty vehicles cost the ROS master, too."""
LONGEST = 5.0
"""Upper limit of the wall time between two readings that this share leads to, s."""


class BridgeGraph:
    """A cache of the ROS graph."""

    def __init__(
        self,
        uri: str,
        topics: Sequence[str],
        oldest: float,
        clock: Callable[[], float] = time.monotonic,
        read: Callable[[str], TopicGraph] = read_topics,
    ) -> None:
        """Initialise.

        Args:
            uri: of the ROS master.
            topics: shell patterns of the topics' names.
            oldest: age after which the graph is read again, s; up to ``LONGEST`` where reading takes long.
            clock: monotonic, s.
            read: reads the graph of a master.
        """
        self._uri = uri
        self._patterns = tuple(topics)
        self._oldest = oldest
        self._clock = clock
        self._read = read
        self._lock = threading.Lock()
        self._graph = TopicGraph({}, {})
        self._due = float("-inf")

    def is_open(self, topic: str) -> bool:
        """Return whether a pattern matches a topic's name."""
        return any(fnmatch.fnmatchcase(topic, pattern) for pattern in self._patterns)

    def read(self) -> TopicGraph:
        """Return the graph.

        Raises:
            MasterError: the master does not answer.
        """
        with self._lock:
            begin = self._clock()
            if begin >= self._due:
                graph = self._read(self._uri)
                topics = {name: topic for name, topic in graph.topics.items() if self.is_open(name)}
                self._graph = TopicGraph(topics, graph.services)
                end = self._clock()
                self._due = end + max(self._oldest, min((end - begin) / SHARE, LONGEST))
            return self._graph

    def topic_type(self, topic: str) -> str:
        """Return the type of a topic, empty if it is unknown; raises as ``read``."""
        found = self.read().topics.get(topic)
        return "" if found is None or found.type == UNKNOWN_TYPE else found.type
