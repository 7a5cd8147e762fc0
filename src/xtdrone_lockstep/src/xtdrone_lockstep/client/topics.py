"""Publishers and subscribers of a node in lockstep, used like rospy's."""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Collection
from typing import Any

import genpy
import rospy
import rospy.topics
from rospy.core import is_initialized
from rospy.impl.registration import Registration

from ..protocol import Digest
from ..transport.outlets import Outlet
from ..transport.publisher import acquire_publisher
from ..transport.subscriber import acquire_subscriber
from .node_state import this_node


class _Arrivals(rospy.SubscribeListener):
    """Sets an event whenever a subscriber connects."""

    def __init__(self) -> None:
        super().__init__()
        self.event = threading.Event()

    def peer_subscribe(self, topic_name: str, topic_publish: Any, peer_publish: Any) -> None:
        """Handle a new connection; called by rospy."""
        self.event.set()


class _Publisher(rospy.Publisher):
    """rospy's publisher, with less work per message in the usual call: one argument, a message of the topic's class."""

    _initialised = False

    def publish(self, *args: Any, **kwds: Any) -> None:
        """Publish a message, like rospy.Publisher.

        Raises:
            ROSException: The node is not initialised, or the topic is unregistered or closed.
            ROSSerializationException: The message cannot be serialised.
        """
        impl = self.impl
        if impl is None or kwds or len(args) != 1 or type(args[0]) is not self.data_class or not self._initialised:
            self._initialised = is_initialized()  # stays so until the process ends
            super().publish(*args, **kwds)
            return
        try:
            impl.publish(args[0])
        except genpy.SerializationError as error:
            raise rospy.ROSSerializationException(str(error)) from error


class Publisher(_Publisher):
    """A publisher whose messages are counted; ``publish`` returns when the bytes are in the kernel.

    A stalled subscriber does not stall the node: messages it does not accept are queued and sent by a thread. Beyond
    ``queue_size`` messages the oldest are dropped, unless the subscriber is a participant.
    """

    def __init__(
        self,
        name: str,
        data_class: type[rospy.Message],
        latch: bool = False,
        queue_size: int = 100,
        subscriber_listener: rospy.SubscribeListener | None = None,
    ) -> None:
        """Advertise a topic.

        Args:
            name: Topic name, resolved as usual.
            data_class: Message type.
            latch: Whether to send the last message to every new subscriber.
            queue_size: Messages kept for a stalled subscriber that is not a participant.
            subscriber_listener: As for rospy.Publisher.

        Raises:
            ROSException: The topic has a plain rospy.Publisher in this process.
        """
        impl = acquire_publisher(name, data_class, latch, this_node)
        super().__init__(name, data_class, subscriber_listener=subscriber_listener, latch=latch, queue_size=queue_size)
        this_node.add_publisher(self.resolved_name, impl)

    def get_num_connections(self) -> int:
        """Return the number of subscribers; digests, if requested, count as one.

        With digests the messages are published in any case, so that a flight does not depend on other subscribers.
        """
        return int(super().get_num_connections()) + (this_node.digests is not None)

    def wait_for_subscriber(self, node: str, timeout: float) -> bool:
        """Wait until a node has subscribed; a node outside the lockstep would miss earlier messages.

        Args:
            node: Name of the node, resolved as usual.
            timeout: Longest wait in wall seconds.

        Returns:
            Whether it has subscribed.
        """
        name = rospy.resolve_name(node)
        arrivals = _Arrivals()
        self.impl.add_subscriber_listener(arrivals)
        end = time.monotonic() + timeout
        while not any(connection.endpoint_id == name for connection in self.impl.connections):
            left = end - time.monotonic()
            if left <= 0.0 or not arrivals.event.wait(left):
                return False
            arrivals.event.clear()
        return True

    def unregister(self) -> None:
        """Stop publishing the topic."""
        name, impl = self.resolved_name, self.impl
        super().unregister()
        if impl is not None and impl.ref_count == 0:
            this_node.remove_publisher(name)


class _UnusedLedger:
    """A ledger whose counts are not reported."""

    def __init__(self) -> None:
        self.dirty: deque[Outlet] = deque()
        self.digests: dict[str, Digest] | None = None
        self.time_us = 0

    def outlet_made(self, outlet: Outlet) -> None:
        """Ignore the connection."""

    def outlet_lost(self, outlet: Outlet) -> None:
        """Ignore the connection."""


class UncountedPublisher(_Publisher):
    """A publisher that sends like ``Publisher`` without counting, for topics that no participant waits for (/clock).

    With a queue size, rospy's own publisher passes each message to another thread, which costs several times as much.
    """

    def __init__(
        self, name: str, data_class: type[rospy.Message], queue_size: int = 100, rare: Collection[str] = ()
    ) -> None:
        """Advertise a topic.

        Args:
            name: Topic name, resolved as usual.
            data_class: Message type.
            queue_size: Messages kept for a stalled subscriber.
            rare: Names of subscribers that need only some of the messages: they get ten in each wall second.

        Raises:
            ROSException: The topic has a plain rospy.Publisher in this process.
        """
        acquire_publisher(name, data_class, False, _UnusedLedger()).rare = rare
        super().__init__(name, data_class, queue_size=queue_size)


class Subscriber(rospy.topics.Topic):
    """A subscriber whose callback runs in ``Rate.sleep``, in the calling thread."""

    def __init__(
        self,
        name: str,
        data_class: type[rospy.Message],
        callback: Callable[..., None] | None = None,
        callback_args: Any = None,
        queue_size: int | None = None,
        buff_size: int = rospy.topics.DEFAULT_BUFF_SIZE,
    ) -> None:
        """Subscribe to a topic.

        Args:
            name: Topic name, resolved as usual.
            data_class: Message type.
            callback: Called with each message, and with ``callback_args`` if given.
            callback_args: Second argument of the callback.
            queue_size: Maximum number of messages (the newest) dispatched at a time from a publisher that is not a
                participant; messages of participants are never dropped.
            buff_size: Receive buffer in bytes.

        Raises:
            ROSException: The topic has a plain rospy.Subscriber in this process, or the queue size is not positive.
        """
        impl = acquire_subscriber(name, data_class, this_node.reader)
        super().__init__(name, data_class, Registration.SUB)
        impl.set_queue_size(queue_size)
        if buff_size != rospy.topics.DEFAULT_BUFF_SIZE:
            impl.set_buff_size(buff_size)
        self.callback = callback
        self.callback_args = callback_args
        self.pending = impl.latches()
        this_node.add_subscriber(self)

    def invoke(self, message: rospy.Message) -> None:
        """Run the callback; an exception in it is logged and does not end the node, as in rospy."""
        if self.callback is None:
            return
        try:
            if self.callback_args is None:
                self.callback(message)
            else:
                self.callback(message, self.callback_args)
        except Exception:
            rospy.logerr(f"bad callback for {self.resolved_name}: {traceback.format_exc()}")

    def unregister(self) -> None:
        """End the subscription."""
        if not this_node.remove_subscriber(self):
            return
        self.callback = None
        super().unregister()
        this_node.topics_changed()
