"""The simulator's own publishers and subscribers in the lockstep."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Collection, Mapping
from typing import Any

from ..protocol import Digest
from ..transport.outlets import Outlet
from .messages_due import Deliveries
from .node_state import Node


class Host:
    """Counts the messages of the simulator's own process, for ``LockstepServer.attach_host``.

    Messages that participants send to its subscribers in a tick are dispatched by ``receive`` after the barrier of that
    tick; those of other publishers by the next ``receive``. All of this happens in the simulator's thread and in the
    same order as in a participant.

    Attributes:
        name: Node name of the simulator.
    """

    def __init__(self, name: str, node: Node) -> None:
        """Report the topics and connections of a node.

        Args:
            name: Node name of the simulator.
            node: The node.
        """
        self.name = name
        self._node = node
        self._topics_changed = True
        self._made: deque[list[Any]] = deque()
        self._lost: deque[int] = deque()
        self._last_number = 0
        self._outlets: dict[int, Outlet] = {}
        self._lock = threading.Lock()
        self._deliveries = Deliveries(node)
        self._counts: dict[int, int] = {}

    # ---- called by the simulator ----

    def want_digests(self) -> Mapping[str, Digest]:
        """Start digests of all published messages and return them by topic; they grow with every message."""
        if self._node.digests is None:
            self._node.digests = {}
        return self._node.digests

    def time_passed(self, time_us: int) -> None:
        """Set the simulation time in microseconds for the digests."""
        self._node.time_us = time_us

    def receive(self) -> None:
        """Run the callbacks of received messages; call it after each ``LockstepServer.tick``, in the same thread.

        Raises:
            ROSInterruptException: The node is shut down while waiting for a message.
        """
        if not self._node.subscribers:
            return
        self._node.reader.wait(0.0)
        counts, self._counts = self._counts, {}
        self._deliveries.fetch(counts)
        self._node.dispatch()

    # ---- called by the node ----

    def topics_changed(self) -> None:
        """Report the topics with the next ``collect``."""
        self._topics_changed = True

    def outlet_made(self, outlet: Outlet) -> None:
        """Report a new connection with the next ``collect``; called in rospy's threads."""
        with self._lock:
            if outlet.number or outlet.closed:
                return
            self._last_number += 1
            outlet.number = self._last_number
            self._outlets[outlet.number] = outlet
            self._made.append([outlet.number, outlet.topic, outlet.peer, outlet.port, outlet.count])

    def outlet_lost(self, outlet: Outlet) -> None:
        """Report with the next ``collect`` that a connection is closed; called in any thread."""
        with self._lock:
            if self._outlets.pop(outlet.number, None) is not None:
                self._lost.append(outlet.number)

    # ---- called by the server, see ``server.HostLink`` ----

    def collect(self) -> tuple[dict[str, Any] | None, list[list[Any]], list[int], dict[int, int]]:
        """Return the changes since the last call: declaration or None, peers made, numbers of peers lost, counts."""
        declaration = None
        if self._topics_changed:
            self._topics_changed = False
            declaration = self._node.declaration()
        # Counts before connections: a counted connection has then been reported before or is reported by this call.
        counts = self._node.take_counts()
        made, lost = [], []
        # Losses before connections: rospy's threads add both, and a lost connection has then been reported before or is
        # reported by this call.
        while self._lost:
            lost.append(self._lost.popleft())
        while self._made:
            made.append(self._made.popleft())
        return declaration, made, lost, counts

    def counted(self, number: int, value: bool) -> None:
        """Set whether a connection's subscriber is a participant, whose messages are never dropped."""
        outlet = self._outlets.get(number)
        if outlet is not None:
            outlet.participant = value

    def connect_again(self, topics: Collection[str]) -> None:
        """Ask the master again for participants to which a subscribed topic has no connection."""
        self._node.connect_again(topics)

    def deliver(self, news: Mapping[str, Any], counts: Mapping[int, int]) -> None:
        """Accept the numbers of messages sent to the simulator by the end of a tick; ``receive`` dispatches them."""
        self._deliveries.update(news)
        self._counts.update(counts)
