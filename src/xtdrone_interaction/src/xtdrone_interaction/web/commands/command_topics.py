"""Publish on topics whose subscribers exist already, such as XTDrone's commands."""

from __future__ import annotations

import threading
from typing import Any

import genpy
import rosgraph
import rospy

from xtdrone_interaction.web.server.methods import CallError

_CONNECT_LIMIT = 2.0  # s of wall time for the subscriber to connect


class _Connected(rospy.SubscribeListener):
    """Counts the subscribers that have connected."""

    def __init__(self) -> None:
        super().__init__()
        self._changed = threading.Condition()
        self._count = 0

    def peer_subscribe(self, *_: Any) -> None:
        with self._changed:
            self._count += 1
            self._changed.notify_all()

    def wait(self, count: int) -> None:
        """Wait until so many have connected, at most ``_CONNECT_LIMIT``."""
        with self._changed:
            self._changed.wait_for(lambda: self._count >= count, _CONNECT_LIMIT)


def _subscribers(topic: str) -> int:
    """Return how many nodes subscribe to a topic."""
    _, subscribed, _ = rosgraph.Master(rospy.get_name()).getSystemState()
    return len(dict(subscribed).get(topic, ()))


class CommandTopics:
    """Publishers, made when they are first needed."""

    def __init__(self) -> None:
        self._publishers: dict[str, tuple[rospy.Publisher, _Connected]] = {}
        self._lock = threading.Lock()

    def publish(self, topic: str, message: genpy.Message) -> None:
        """Publish a message once all subscribers are connected; blocks for at most 2 s.

        Raises:
            CallError: no node subscribes to the topic.
        """
        with self._lock:
            known = topic in self._publishers
            if not known:
                connected = _Connected()
                publisher = rospy.Publisher(topic, type(message), subscriber_listener=connected, queue_size=10)
                self._publishers[topic] = publisher, connected
            publisher, connected = self._publishers[topic]
        if not known or not publisher.get_num_connections():
            connected.wait(max(1, _subscribers(topic)))
        if not publisher.get_num_connections():
            with self._lock:
                self._publishers.pop(topic, None)
            publisher.unregister()
            raise CallError(f"topic: no node subscribes to {topic}; ./xtdrone doctor names what is missing")
        publisher.publish(message)
