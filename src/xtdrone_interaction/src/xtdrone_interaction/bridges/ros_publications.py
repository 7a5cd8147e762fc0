"""Topics that the clients of a bridge publish: checked against the graph, shared by the clients, bounded in number."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any

from xtdrone_interaction.topics.message_classes import MessageTypeError, installed_class
from xtdrone_interaction.topics.ros_names import absolute_name

MAX_TOPICS = 200
"""Maximum number of topics published by the clients of a bridge."""
_PATIENCE = 1.0  # s after advertising for the subscribers to connect, since they would miss the first message
_LOOK = 0.005  # s
_QUEUE = 100  # messages queued per connection for a slow subscriber; beyond this, the oldest are dropped


class PublicationError(ValueError):
    """A topic that cannot be advertised or published."""


@dataclass
class _Publication:
    """A topic that clients publish."""

    type: str
    latch: bool
    publisher: Any
    until: float  # monotonic time until which a message waits for the subscribers, s
    owners: set[Hashable] = field(default_factory=set)


class Publications:
    """The publishers of a bridge. A publisher is closed with its last owner."""

    def __init__(
        self, publisher: Callable[..., Any], topic_type: Callable[[str], str], subscribers: Callable[[str], int]
    ) -> None:
        """Initialise without topics.

        Args:
            publisher: ``rospy.Publisher``.
            topic_type: returns the type of a topic in the graph, empty if it is unknown.
            subscribers: returns the number of nodes that subscribe to a topic.
        """
        self._make = publisher
        self._topic_type = topic_type
        self._subscribers = subscribers
        self._lock = threading.Lock()
        self._topics: dict[str, _Publication] = {}

    def advertise(self, owner: Hashable, topic: str, type_: str, *, latch: bool = False) -> Any:
        """Advertise a topic for an owner; return the class of its messages.

        Args:
            owner: client that needs it.
            topic: its name.
            type_: its type; empty: its type in the graph.
            latch: whether a later subscriber receives the last message.

        Raises:
            RosNameError: the name is not allowed.
            PublicationError: the topic has another type, the type is unknown, or there are too many topics.
        """
        topic = absolute_name(topic, "topic")
        with self._lock:
            present = self._topics.get(topic)
            known = present.type if present is not None else self._topic_type(topic)
            if not (type_ or known):
                raise PublicationError(f"topic: the type of {topic} is unknown, advertise it with a type")
            if type_ and known and type_ != known:
                raise PublicationError(f"topic: {topic} of type {type_} is not allowed, it has the type {known}")
            try:
                kind = installed_class(type_ or known)
            except MessageTypeError as error:
                raise PublicationError(f"topic: {topic}: {error}") from error
            if present is None:
                if len(self._topics) >= MAX_TOPICS:
                    raise PublicationError(f"topic: {topic} is one too many, at most {MAX_TOPICS} at a time")
                made = self._make(topic, kind, queue_size=_QUEUE, latch=latch)
                present = self._topics[topic] = _Publication(type_ or known, latch, made, time.monotonic() + _PATIENCE)
            present.owners.add(owner)
            return kind

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message on an advertised topic; if just advertised, wait up to 1 s for its subscribers.

        Raises:
            PublicationError: it is not advertised, or the message cannot be serialised.
        """
        present = self._topics.get(topic)
        if present is None:
            raise PublicationError(f"topic: {topic} is not advertised")
        if present.until:
            self._wait_for_subscribers(topic, present)
        try:
            present.publisher.publish(message)
        except Exception as error:  # rospy.ROSSerializationException, or any error of genpy for a field's value
            raise PublicationError(f"topic: {topic}: {error}") from error

    def _wait_for_subscribers(self, topic: str, present: _Publication) -> None:
        expected = self._subscribers(topic)
        while present.publisher.get_num_connections() < expected and time.monotonic() < present.until:
            time.sleep(_LOOK)
        present.until = 0.0

    def unadvertise(self, owner: Hashable, topic: str) -> None:
        """End an owner's interest in a topic; ignored if it has not advertised it."""
        with self._lock:
            present = self._topics.get(topic)
            if present is None or owner not in present.owners:
                return
            present.owners.discard(owner)
            if not present.owners:
                self._topics.pop(topic).publisher.unregister()

    def leave(self, owner: Hashable) -> None:
        """End an owner's interest in all topics."""
        for topic in [name for name, present in list(self._topics.items()) if owner in present.owners]:
            self.unadvertise(owner, topic)
