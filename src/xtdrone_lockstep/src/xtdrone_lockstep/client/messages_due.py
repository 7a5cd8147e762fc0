"""The connections from participants to this process's subscribers, and the messages due on each."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import rospy
import rospy.core

from ..transport.inbox import Inbox
from .node_state import Node

WAIT_LIMIT = 60.0
"""Wall seconds to wait for a counted message while its publisher's connection is open."""
WAIT_REPORT = 5.0
"""Wall seconds after which such a wait is logged."""


class Deliveries:
    """Reads counted messages before they are dispatched."""

    def __init__(self, node: Node) -> None:
        """Start without connections.

        Args:
            node: Owner of the subscribers and of the reader of their connections.
        """
        self._node = node
        self._inboxes: dict[int, Inbox] = {}
        self._topics: dict[int, str] = {}
        self._lost: list[int] = []
        self._void: list[tuple[int, int]] = []

    def update(self, news: Mapping[str, Any]) -> None:
        """Apply the contents of a PEER frame: connections made and lost, and messages made void by a reset."""
        for channel, topic, publisher, port in news["made"]:
            end = self._node.ends.get(topic)
            if end is None:  # a plain rospy.Subscriber (of a tf listener, say), read by rospy's threads
                continue
            inbox = end.inbox(publisher, port)
            self._node.reader.count(inbox)
            self._inboxes[channel] = inbox
            self._topics[channel] = topic
        self._lost += [channel for channel in news["lost"] if channel in self._inboxes]
        self._void += [(channel, count) for channel, count in news.get("void", ()) if channel in self._inboxes]

    def channels_of(self, topic: str) -> list[tuple[int, Inbox]]:
        """Return the connections from participants to a topic of this process, with their numbers."""
        return [(channel, inbox) for channel, inbox in self._inboxes.items() if self._topics[channel] == topic]

    def fetch(self, counts: Mapping[int, int]) -> None:
        """Read the messages due by now, waiting for those that have not arrived; discard void and closed ones.

        Args:
            counts: Cumulative number of messages sent by channel, where it changed.

        Raises:
            ROSInterruptException: The node is shut down meanwhile.
        """
        if not (counts or self._void or self._lost):
            return
        awaited = {}
        for channel, count in counts.items():
            inbox = self._inboxes.get(channel)
            if inbox is None:
                continue
            inbox.target = count
            if not inbox.fetch():
                awaited[channel] = inbox
        if awaited:
            self._await_messages(awaited)
        for channel, count in self._void:
            self._inboxes[channel].discard(count)
        self._void.clear()
        for channel in self._lost:
            self._inboxes.pop(channel).lost = True
            del self._topics[channel]
        self._lost.clear()

    def _await_messages(self, awaited: Mapping[int, Inbox]) -> None:
        reader, began = self._node.reader, time.monotonic()
        lacking = reader.await_messages(awaited.values(), began + WAIT_REPORT)
        if lacking and not rospy.core.is_shutdown_requested():
            names = sorted({f"{self._topics[channel]} from {inbox.publisher}" for channel, inbox in awaited.items()})
            rospy.logwarn(f"waiting for messages that have been sent: {', '.join(names)}")
            lacking = reader.await_messages(awaited.values(), began + WAIT_LIMIT)
        if rospy.core.is_shutdown_requested():
            raise rospy.ROSInterruptException("ROS shutdown request")
        for channel, inbox in awaited.items():
            if inbox not in lacking:
                continue
            short = inbox.lacking()
            inbox.given_up += short
            rospy.logwarn(
                f"{short} messages on {self._topics[channel]} from {inbox.publisher} did not arrive within "
                f"{WAIT_LIMIT:g} s; continuing without them"
            )
