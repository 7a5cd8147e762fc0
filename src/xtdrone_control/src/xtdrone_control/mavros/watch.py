"""Names publishers on MAVROS topics that nothing here takes: without a subscriber their messages go nowhere.

The master is asked now and then, in wall time and in a thread of its own, so that no topic needs a subscription and the
simulation is not touched. The larger the ROS graph, the more seldom.
"""

from __future__ import annotations

import difflib
import logging
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import NamedTuple

from xtdrone_control.mavros.left_out import LeftOut, explain

log = logging.getLogger("rosout.mavros")

PERIOD = 5.0  # s of wall time between looks, at least
_SHARE = 200.0  # a look may take this part of the time
_LIKENESS = 0.85

Registrations = Mapping[str, Collection[str]]  # topic to the names of nodes


class Finding(NamedTuple):
    """A topic that nothing here takes, a node that publishes on it, and the words for a user."""

    topic: str
    node: str
    text: str


class Watch:
    """The looks at the graph; each topic is told of once."""

    def __init__(
        self,
        own_name: str,
        prefixes: Collection[str],
        left_out: Mapping[str, LeftOut],
        system_state: Callable[[], tuple[Registrations, Registrations]],
    ) -> None:
        """Prepare.

        Args:
            own_name: this node's name.
            prefixes: where vehicles' topics are, as ``/iris_0/mavros``.
            left_out: topics below these that MAVROS takes and this node does not.
            system_state: asks for publishers and subscribers by topic; may raise OSError.
        """
        self._own_name = own_name
        self._prefixes = frozenset(prefixes)
        self._left_out = left_out
        self._system_state = system_state
        self._told: set[str] = set()
        self._ending = threading.Event()

    def start(self) -> None:
        """Begin to look, in a daemon thread."""
        threading.Thread(target=self._run, name="mavros watch", daemon=True).start()

    def stop(self) -> None:
        """Look no more."""
        self._ending.set()

    def look(self) -> None:
        """Look once, and warn of what is new.

        Raises:
            OSError: the master does not answer.
        """
        for finding in self.findings(*self._system_state()):
            if finding.topic not in self._told:
                self._told.add(finding.topic)
                log.warning("%s, on which %s publishes, %s", *finding)

    def findings(self, publishers: Registrations, subscribers: Registrations) -> Iterator[Finding]:
        """Yield what goes nowhere, of a state of the graph."""
        for topic, nodes in sorted(publishers.items()):
            others = sorted(set(nodes) - {self._own_name})
            if not others or self._own_name in nodes or self._own_name in subscribers.get(topic, ()):
                continue
            text = self._words(topic, subscribers)
            if text:
                yield Finding(topic, others[0], text)

    def _words(self, topic: str, subscribers: Registrations) -> str:
        prefix = self._prefix(topic)
        if prefix is None:
            return self._without_vehicle(topic, subscribers)
        name = topic[len(prefix) + 1 :]
        entry = self._left_out.get(name)
        if entry is not None:
            return f"is not taken here: {explain(entry)}"
        if subscribers.get(topic):
            return ""
        own = [known for known, nodes in subscribers.items() if self._own_name in nodes and known.startswith(prefix)]
        alike = difflib.get_close_matches(topic, own, 1, _LIKENESS)
        if alike:
            return f"has no subscriber; is {alike[0]} meant?"
        return "has no subscriber: no plugin that is loaded takes it; plugin_denylist may leave its plugin out"

    def _without_vehicle(self, topic: str, subscribers: Registrations) -> str:
        """Return the words for a topic below ``/mavros`` when vehicles have namespaces."""
        head, _, name = topic[1:].partition("/")
        if head != "mavros" or self._own_name in self._prefixes or subscribers.get(topic) or not name:
            return ""
        prefix = min(self._prefixes)
        return f"belongs to no vehicle and has no subscriber; the vehicles' topics are {prefix}/{name} and so on"

    def _prefix(self, topic: str) -> str | None:
        end = topic.find("/", 1)
        while end > 0:
            if topic[:end] in self._prefixes:
                return topic[:end]
            end = topic.find("/", end + 1)
        return None

    def _run(self) -> None:
        pause = PERIOD
        while not self._ending.wait(pause):
            begin = time.monotonic()
            try:
                self.look()
            except OSError as error:
                log.debug("the master does not name publishers: %s", error)
            pause = max(PERIOD, _SHARE * (time.monotonic() - begin))
