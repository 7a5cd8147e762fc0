"""Publish on topics by hand, so that the first message, too, reaches every subscriber."""

from __future__ import annotations

import threading
import time
from typing import Any

import genpy
import rospy

from xtdrone_control import lockstep
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

    def publish(self, topic: str, message: genpy.Message) -> int:
        """Publish a message once the subscribers that the master names are connected; blocks for at most 2 s.

        Returns:
            The number of subscribers.

        Raises:
            TooManyTopicsError: the topic is one too many.
        """
        publisher = self._publisher(topic, type(message))
        publisher.publish(message)
        return int(publisher.get_num_connections())

    def connect(self, topic: str, kind: type[genpy.Message]) -> int:
        """Connect to the subscribers without publishing; as ``publish``."""
        return int(self._publisher(topic, kind).get_num_connections())

    def _publisher(self, topic: str, kind: type[genpy.Message]) -> Any:
        with self._lock:
            return self._publishers.get(topic) or self._connected(topic, kind)

    def _connected(self, topic: str, kind: type[genpy.Message]) -> Any:
        if len(self._publishers) >= self._most:
            raise TooManyTopicsError(f"topic: {topic!r} is one more than the {self._most} that may be published here")
        publisher = self._publishers[topic] = lockstep.UncountedPublisher(topic, kind, queue_size=_KEPT)
        arrival = threading.Event()
        listener = rospy.SubscribeListener()
        listener.peer_subscribe = lambda *_: arrival.set()
        publisher.impl.add_subscriber_listener(listener)
        expected = self._subscribers(topic) - {rospy.get_name()}
        end = time.monotonic() + _CONNECT_LIMIT
        while expected - {connection.endpoint_id for connection in list(publisher.impl.connections)}:
            if not arrival.wait(max(0.0, end - time.monotonic())):
                break
            arrival.clear()
        return publisher

    def _subscribers(self, topic: str) -> set[str]:
        try:
            found = read_topics(self._master).topics.get(topic)
        except MasterError:
            return set()
        return set() if found is None else set(found.subscribers)
