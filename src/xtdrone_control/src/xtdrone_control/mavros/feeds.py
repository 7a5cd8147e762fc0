"""Topics of a plugin and the MAVLink messages that feed them, and the interface to ROS that both use."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol


class Publisher(Protocol):
    """What is needed of a ROS publisher."""

    def publish(self, message: Any) -> None:
        """Send a message."""

    def get_num_connections(self) -> int:
        """Return how many subscribers there are."""


class Ros(Protocol):
    """What plugins need of ROS, so that tests run them without a master.

    Attributes:
        use_sim_time: the autopilot's boot time is the ROS time.
    """

    use_sim_time: bool

    def now_ns(self) -> int:
        """Return the ROS time in nanoseconds."""

    def publisher(self, topic: str, kind: type, latch: bool) -> Publisher:
        """Advertise ``topic``."""

    def subscriber(self, topic: str, kind: type, callback: Callable[[Any], None]) -> None:
        """Subscribe; callbacks come in the main thread."""

    def service(self, name: str, kind: type, handler: Callable[[Any], Any]) -> None:
        """Offer a service; handlers run in threads of their own."""

    def set_param(self, name: str, value: Any) -> None:
        """Set a parameter of ROS's, or a tree of them."""

    def get_param(self, name: str, default: Any) -> Any:
        """Return a parameter of ROS's, or a tree of them."""

    def needs_time(self) -> AbstractContextManager[None]:
        """Return what is to be entered while an autopilot's answer is waited for, which may take simulated time."""


class Topic:
    """A topic of a plugin with the one message object that it publishes again and again.

    Attributes:
        message: filled in and published by the plugin; serialised in ``publish``, so it can be reused at once.
        taken: somebody subscribes, or the topic is latched and must know its last value.
    """

    __slots__ = ("_latch", "_publisher", "message", "publish", "taken")

    def __init__(self, publisher: Publisher, message: Any, latch: bool) -> None:
        """Take the publisher and the message to reuse."""
        self._publisher = publisher
        self._latch = latch
        self.message = message
        self.publish = publisher.publish
        self.taken = latch

    def refresh(self) -> None:
        """Look whether somebody subscribes."""
        self.taken = self._latch or self._publisher.get_num_connections() > 0


class Feed:
    """A plugin's interest in a MAVLink message.

    Attributes:
        handler: takes the decoded message; None when only the latest one is kept, for ``Uas.latest``.
        topics: the message is wanted while one of them is taken.
        always: it is wanted in any case.
        anyone: it is taken from every system and component on the link, not from the autopilot alone.
        all_streams: while it is wanted, whatever the autopilot can send is.
    """

    def __init__(
        self,
        handler: Callable[[Any], None] | None,
        *topics: Topic,
        always: bool = False,
        anyone: bool = False,
        all_streams: bool = False,
    ) -> None:
        """Take handler and topics."""
        self.handler = handler
        self.topics = topics
        self.always = always
        self.anyone = anyone
        self.all_streams = all_streams

    @property
    def wanted(self) -> bool:
        """Whether the message is wanted now."""
        return self.always or any(topic.taken for topic in self.topics)
