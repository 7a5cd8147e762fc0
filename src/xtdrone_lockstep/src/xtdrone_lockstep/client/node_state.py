"""The state of this process's node: declared topics, message counts and turns."""

from __future__ import annotations

import traceback
from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Any, Protocol

import rospy

from ..protocol import Digest
from ..transport.inbox import Inbox
from ..transport.outlets import Outlet
from ..transport.publisher import CountingPublisher
from ..transport.rospy_internals import ask_master_again
from ..transport.subscriber import BufferingSubscriber
from ..transport.topic_reader import Reader

Serve = Callable[[Mapping[int, int] | None, float], Mapping[int, int]]
"""Receives datagrams, see ``api.declare_udp``."""


class Counter(Protocol):
    """Reports this node's connections and topics to the server: a participant's client, or the simulator's host."""

    def outlet_made(self, outlet: Outlet) -> None:
        """Report a new connection; called in rospy's threads."""

    def outlet_lost(self, outlet: Outlet) -> None:
        """Report that a connection is closed; called in any thread."""

    def topics_changed(self) -> None:
        """Report that topics were added or removed."""


class Subscription(Protocol):
    """A declared subscriber, see ``topics.Subscriber``.

    Attributes:
        resolved_name: Resolved topic name.
        type: Message type, such as std_msgs/String.
        impl: The topic's receiving end; None once unregistered.
        pending: Latched messages that arrived before this subscriber was declared.
    """

    resolved_name: str
    type: str
    impl: BufferingSubscriber | None
    pending: list[Any]

    def invoke(self, message: Any) -> None:
        """Run the callback."""


class Node:
    """The node of this process; it is also the ledger of its publishers (``transport.outlets.Ledger``).

    Attributes:
        rate: Turns per second of simulation time in Hz.
        taking_part: Whether the node is a participant, i.e. in lockstep with a simulator.
        publishers: The publishing ends by topic.
        subscribers: The declared subscribers, in order of declaration.
        ends: The receiving ends by topic.
        reader: Reads the topic connections of a participant.
        dirty: Announced outlets whose count has changed since it was last reported.
        digests: Digests of the published messages by topic; None if not requested.
        time_us: Simulation time of the current turn in microseconds.
        reset_hooks: Functions to call when simulation time was reset.
        crash: The exception that ends the program; empty if there is none.
        exit_status: Exit status that the program should end with.
        counter: Reports connections to the server; None before the node has joined.
        udp_ports: Local ports on which the node receives the simulator's datagrams.
        serve: Function that receives these datagrams; None if there are none.
        datagrams: Cumulative number of datagrams sent, by the simulator's port.
        datagrams_missed: Number of datagrams given up as lost, by local port.
    """

    def __init__(self) -> None:
        self.rate = 0.0
        self.taking_part = False
        self.publishers: dict[str, CountingPublisher] = {}
        self.subscribers: dict[Subscription, None] = {}
        self.ends: dict[str, BufferingSubscriber] = {}
        self.reader = Reader()
        self.dirty: deque[Outlet] = deque()
        self.digests: dict[str, Digest] | None = None
        self.time_us = 0
        self.reset_hooks: list[Callable[[], None]] = []
        self.crash = ""
        self.exit_status = 0
        self.counter: Counter | None = None
        self.udp_ports: list[int] = []
        self.serve: Serve | None = None
        self.datagrams: dict[int, int] = {}
        self.datagrams_missed: dict[int, int] = {}
        self._subscribers_of: dict[str, int] = {}  # number by topic
        self._connected: list[tuple[Subscription, tuple[Inbox, ...]]] = []
        self._subscribers_changed = False

    # ---- topics ----

    def add_publisher(self, name: str, impl: CountingPublisher) -> None:
        """Add a topic's publishing end, unless it is there already."""
        if self.publishers.get(name) is not impl:
            self.publishers[name] = impl
            self.topics_changed()

    def remove_publisher(self, name: str) -> None:
        """Remove a topic's publishing end."""
        self.publishers.pop(name, None)
        self.topics_changed()

    def add_subscriber(self, subscriber: Subscription) -> None:
        """Add a subscriber."""
        name = subscriber.resolved_name
        self.subscribers[subscriber] = None
        self._subscribers_changed = True
        count = self._subscribers_of[name] = self._subscribers_of.get(name, 0) + 1
        if count == 1 and subscriber.impl is not None:
            self.ends[name] = subscriber.impl
            self.topics_changed()

    def remove_subscriber(self, subscriber: Subscription) -> bool:
        """Remove a subscriber; return whether it was there."""
        if subscriber not in self.subscribers:
            return False
        del self.subscribers[subscriber]
        self._subscribers_changed = True
        name = subscriber.resolved_name
        self._subscribers_of[name] -= 1
        if not self._subscribers_of[name]:
            del self._subscribers_of[name], self.ends[name]
        return True

    def topics_changed(self) -> None:
        """Report topics that were added or removed after joining."""
        if self.counter is not None:
            self.counter.topics_changed()

    def declaration(self) -> dict[str, list[list[str]]]:
        """Return all topics with their types, as in JOIN and DECLARE."""
        subscribed = {entry.resolved_name: entry.type for entry in list(self.subscribers)}
        return {
            "publications": [[name, impl.type] for name, impl in list(self.publishers.items())],
            "subscriptions": [[name, kind] for name, kind in subscribed.items()],
        }

    def connect_again(self, topics: Collection[str]) -> None:
        """Ask the master again for publishers to which a subscribed topic has no connection."""
        for topic in topics:
            if topic in self.ends:
                self.ends[topic].close_stalled()
        ask_master_again(topics)

    # ---- ledger ----

    def outlet_made(self, outlet: Outlet) -> None:
        """Report a new connection."""
        if self.counter is not None:
            self.counter.outlet_made(outlet)

    def outlet_lost(self, outlet: Outlet) -> None:
        """Report that a connection is closed."""
        if self.counter is not None:
            self.counter.outlet_lost(outlet)

    def outlets(self) -> list[Outlet]:
        """Return the open connections."""
        return [outlet for impl in list(self.publishers.values()) for outlet in list(impl.outlets.values())]

    def take_counts(self) -> dict[int, int]:
        """Return the counts that changed since the last call, by connection number."""
        counts = {}
        dirty = self.dirty
        while dirty:
            outlet = dirty.popleft()
            # Cleared before the count is read: a message that another thread is sending is either counted here or marks
            # the outlet dirty again.
            outlet.dirty = False
            counts[outlet.number] = outlet.count
        return counts

    # ---- callbacks ----

    def dispatch(self) -> None:
        """Run the callbacks by subscriber (in order of declaration), publisher's name, and order of sending."""
        ready: dict[int, list[Any]] = {}
        for entry, inboxes in self.connected_subscribers():
            impl = entry.impl
            if impl is None:  # unregistered by an earlier callback
                continue
            messages = ready.get(id(impl))
            if messages is None:
                messages = []
                for inbox in inboxes:
                    if inbox.messages or inbox.closed or inbox.lost:
                        messages = impl.ready()
                        break
                ready[id(impl)] = messages
            if entry.pending:
                messages = [*entry.pending, *messages]
                entry.pending = []
            for message in messages:
                entry.invoke(message)

    def connected_subscribers(self) -> list[tuple[Subscription, tuple[Inbox, ...]]]:
        """Return the subscribers that may have messages, with their inboxes; most of a fleet node's have none."""
        if self.reader.inboxes_changed or self._subscribers_changed:
            self.reader.inboxes_changed = self._subscribers_changed = False
            self._connected = [
                (entry, tuple(entry.impl.inboxes.values()) if entry.impl else ())
                for entry in list(self.subscribers)
                if entry.pending or (entry.impl and entry.impl.inboxes)
            ]
        return self._connected

    def run_reset_hooks(self) -> None:
        """Run the reset hooks; exceptions are logged, as in callbacks."""
        for hook in self.reset_hooks:
            try:
                hook()
            except Exception:
                rospy.logerr(f"bad reset hook: {traceback.format_exc()}")


this_node = Node()
"""The node of this process; like rospy, there is one."""
