"""Publish on topics whose subscribers exist already, such as XTDrone's commands."""

from __future__ import annotations

import threading
from typing import Any

import genpy
import rospy

from xtdrone_interaction.web.server.methods import CallError

_CONNECT_LIMIT = 2.0  # s of wall time for the subscriber to connect


class _Connected(rospy.SubscribeListener):
    def __init__(self) -> None:
        super().__init__()
        self.event = threading.Event()

    def peer_subscribe(self, *_: Any) -> None:
        self.event.set()


class CommandTopics:
    """Publishers, made when they are first needed."""

    def __init__(self) -> None:
        self._publishers: dict[str, tuple[rospy.Publisher, _Connected]] = {}
        self._lock = threading.Lock()

    def publish(self, topic: str, message: genpy.Message) -> None:
        """Publish a message once a subscriber is connected; blocks for at most 2 s.

        Raises:
            CallError: no node subscribes to the topic.
        """
        with self._lock:
            if topic not in self._publishers:
                connected = _Connected()
                publisher = rospy.Publisher(topic, type(message), subscriber_listener=connected, queue_size=10)
                self._publishers[topic] = publisher, connected
            publisher, connected = self._publishers[topic]
        if not publisher.get_num_connections() and not connected.event.wait(_CONNECT_LIMIT):
            with self._lock:
                self._publishers.pop(topic, None)
            publisher.unregister()
            raise CallError(f"topic: no node subscribes to {topic}; ./xtdrone doctor names what is missing")
        publisher.publish(message)
