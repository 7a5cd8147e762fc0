"""Publish on topics by hand, so that the first message, too, reaches every subscriber."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Collection, Mapping
from typing import Any

import genpy
import rospy

import xtdrone_lockstep as lockstep
from xtdrone_interaction.topics.discovery import MasterError, read_topics

_CONNECT_LIMIT = 2.0  # s of wall time for the subscribers to connect
_KEPT = 100  # messages for a slow subscriber


class TooManyTopicsError(ValueError):
    """One topic more than this process may publish."""


class ConnectedPublishers:
    """Publishers, made when they are first needed. ``publish`` returns when the bytes are in the kernel."""

    def __init__(self, master: str, most: int = 500) -> None:
        """Publish nothing yet.

        Args:
            master: URI of the ROS master.
            most: topics.
        """
        self._master = master
        self._most = most
        self._publishers: dict[str, Any] = {}
        self._lock = threading.Lock()
        self._waited: set[str] = set()  # topics whose first message need not wait any more

    def publish(self, topic: str, message: genpy.Message) -> int:
        """Publish a message; the first one on a topic once the subscribers that the master names are connected.

        Blocks for at most 2 s.

        Returns:
            The number of subscribers.

        Raises:
            TooManyTopicsError: the topic is one too many.
        """
        publisher = self._publishers_of({topic: type(message)})[topic]
        if topic not in self._waited:
            self._wait_for_subscribers([topic], _CONNECT_LIMIT)
        publisher.publish(message)
        return int(publisher.get_num_connections())

    def connect(self, topics: Mapping[str, type[genpy.Message]], limit: float = _CONNECT_LIMIT) -> dict[str, int]:
        """Connect to the subscribers of topics, given with their types, without publishing.

        Blocks for at most ``limit`` s of wall time, however many topics there are.

        Returns:
            The number of subscribers by topic.

        Raises:
            TooManyTopicsError: a topic is one too many.
        """
        publishers = self._publishers_of(topics)
        self._wait_for_subscribers(topics, limit)
        return {topic: int(publisher.get_num_connections()) for topic, publisher in publishers.items()}

    def _publishers_of(self, topics: Mapping[str, type[genpy.Message]]) -> dict[str, Any]:
        with self._lock:
            self._advertise({topic: kind for topic, kind in topics.items() if topic not in self._publishers})
            return {topic: self._publishers[topic] for topic in topics}

    def _advertise(self, topics: Mapping[str, type[genpy.Message]]) -> None:
        left = self._most - len(self._publishers)
        if len(topics) > left:
            topic = list(topics)[left]
            raise TooManyTopicsError(f"topic: {topic!r} is one more than the {self._most} that may be published here")
        for topic, kind in topics.items():
            self._publishers[topic] = lockstep.UncountedPublisher(topic, kind, queue_size=_KEPT)

    def _wait_for_subscribers(self, topics: Collection[str], limit: float) -> None:
        arrival = threading.Event()
        listener = rospy.SubscribeListener()
        listener.peer_subscribe = lambda *_: arrival.set()
        publishers = {topic: self._publishers[topic].impl for topic in topics}
        for publisher in publishers.values():
            publisher.add_subscriber_listener(listener)
        end = time.monotonic() + limit
        missing = self._subscribers(topics)
        while True:
            missing = {topic: nodes - _nodes_connected_to(publishers[topic]) for topic, nodes in missing.items()}
            missing = {topic: nodes for topic, nodes in missing.items() if nodes}
            if not missing or not arrival.wait(max(0.0, end - time.monotonic())):
                break
            arrival.clear()
        for publisher in publishers.values():
            with contextlib.suppress(ValueError, AttributeError):  # it has been closed, as the node ends
                publisher.subscriber_listeners.remove(listener)
        self._waited.update(topics)

    def _subscribers(self, topics: Collection[str]) -> dict[str, set[str]]:
        """Return the other nodes that subscribe to each topic; none of a master that does not answer."""
        try:
            graph = read_topics(self._master).topics
        except MasterError:
            return {}
        return {topic: set(graph[topic].subscribers) - {rospy.get_name()} for topic in topics if topic in graph}


def _nodes_connected_to(publisher: Any) -> set[str]:
    return {connection.endpoint_id for connection in list(publisher.connections)}
