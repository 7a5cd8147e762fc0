"""Topics of a plugin, the MAVLink messages that feed them, and the ROS interface that both use."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol


class Publisher(Protocol):
    """The part of a ROS publisher that plugins use."""

    def publish(self, message: Any) -> None:
        """Publish a message."""

    def get_num_connections(self) -> int:
        """Return the number of subscribers."""


class Ros(Protocol):
    """The part of ROS that plugins use; tests run them without a master.

    Attributes:
        use_sim_time: whether the autopilot's boot time equals ROS time.
    """

    use_sim_time: bool

    @property
    def connection_changes(self) -> int:
        """Number of subscriber connections opened and closed so far, on all topics of ``publisher``."""

    def now_ns(self) -> int:
        """Return the ROS time in nanoseconds."""

    def publisher(self, topic: str, kind: type, latch: bool) -> Publisher:
        """Advertise ``topic``."""

    def subscriber(self, topic: str, kind: type, callback: Callable[[Any], None]) -> None:
        """Subscribe to a topic; callbacks run in the main thread."""

    def service(self, name: str, kind: type, handler: Callable[[Any], Any]) -> None:
        """Offer a service; handlers run in separate threads."""

    def set_param(self, name: str, value: Any) -> None:
        """Set a ROS parameter, or a tree of them."""

    def get_param(self, name: str, default: Any) -> Any:
        """Return a ROS parameter, or a tree of them."""

    def needs_time(self) -> AbstractContextManager[None]:
        """Return a context manager for waiting for an autopilot's response, which may need simulated time."""


class Need(Protocol):
    """A need for messages of an autopilot, such as a topic that may have subscribers.

    Attributes:
        needed: whether there is a need now.
    """

    needed: bool

    def refresh(self) -> None:
        """Update ``needed``."""


class Topic:
    """A topic of a plugin with a message object that is reused for every publication.

    Attributes:
        message: filled in and published by the plugin; ``publish`` serialises it, so it can be reused right away.
        needed: whether the topic has subscribers, or is latched and needs its latest value.
    """

    __slots__ = ("_latch", "_publisher", "message", "needed", "publish")

    def __init__(self, publisher: Publisher, message: Any, latch: bool) -> None:
        """Store the publisher and the message to reuse."""
        self._publisher = publisher
        self._latch = latch
        self.message = message
        self.publish = publisher.publish
        self.needed = latch

    def refresh(self) -> None:
        """Update ``needed`` from the number of subscribers."""
        self.needed = self._latch or self._publisher.get_num_connections() > 0


class Feed:
    """A plugin's subscription to a MAVLink message.

    Attributes:
        handler: called with the decoded message; None to keep only the latest one, for ``Uas.latest``.
        topics: the message is needed while any of these topics is.
        always: the message is always needed.
        any_sender: accept it from every system and component on the link, not only from the autopilot.
        all_streams: while it is needed, keep all streams of the autopilot on.
    """

    def __init__(
        self,
        handler: Callable[[Any], None] | None,
        *topics: Need,
        always: bool = False,
        any_sender: bool = False,
        all_streams: bool = False,
    ) -> None:
        """Store the handler and the topics that depend on the message."""
        self.handler = handler
        self.topics = topics
        self.always = always
        self.any_sender = any_sender
        self.all_streams = all_streams

    @property
    def wanted(self) -> bool:
        """Whether the message is needed now."""
        return self.always or any(topic.needed for topic in self.topics)
