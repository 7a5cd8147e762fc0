"""A topic's receiving end that keeps messages, by connection, until the node's own thread dispatches them."""

from __future__ import annotations

import functools
import select
import time
from typing import Any

import rospy
import rospy.topics
from rospy.exceptions import TransportInitError
from rospy.impl.tcpros_base import TCPROSTransport

from xtdrone_lockstep.ros_codec import compile_class

from . import local_topics
from .inbox import FOREIGN_QUEUE, Inbox, TopicFeed
from .rospy_internals import SubscriberImpl, add_subscriber_impl
from .topic_reader import Reader

STALLED = 10.0
"""Wall seconds for a publisher to answer a connection that the simulation waits for."""


class BufferingSubscriber(SubscriberImpl):
    """A topic's receiving end that keeps messages until ``ready`` is called.

    Attributes:
        inboxes: Received messages by publisher's name and local TCP port.
        most_foreign: Maximum number of messages dispatched at a time from a publisher that is not a participant.
    """

    def __init__(self, name: str, data_class: type[rospy.Message], reader: Reader) -> None:
        """Create the end of a topic.

        Args:
            name: Resolved topic name.
            data_class: Message type.
            reader: Reads the connections in the node's own thread while it is active; otherwise rospy's threads do.
        """
        super().__init__(name, data_class)
        codec = compile_class(data_class)
        self._decode_bytes = (lambda data: data_class().deserialize(data)) if codec is None else codec.decode
        self.tcp_nodelay = True
        self.inboxes: dict[tuple[str, int], Inbox] = {}
        self.most_foreign = FOREIGN_QUEUE
        self._reader = reader

    def inbox(self, publisher: str, port: int) -> Inbox:
        """Return the inbox of one connection, created on first use.

        Args:
            publisher: The publisher's name.
            port: Local TCP port of the connection.
        """
        inbox = self.inboxes.get((publisher, port))
        if inbox is None:
            inbox = self.inboxes.setdefault((publisher, port), Inbox(publisher))
            self._reader.inboxes_changed = True
        return inbox

    def set_queue_size(self, queue_size: int | None) -> None:
        """Limit the messages kept from publishers that are not participants; those of participants are never dropped.

        Raises:
            ROSException: The size is not a positive integer.
        """
        if queue_size is None:
            return
        if not isinstance(queue_size, int) or queue_size < 1:
            raise rospy.ROSException(f"{self.resolved_name}: queue_size {queue_size!r} must be a positive integer")
        self.most_foreign = queue_size

    def add_connection(self, connection: Any) -> bool:
        """Add a connection that is handed over once it is made, when rospy calls its ``receive_loop``."""
        connection.begun = time.monotonic()
        connection.receive_loop = functools.partial(self._receive, connection)
        connection.connect = functools.partial(self._connect, connection)
        with self.c_lock:
            # The master may report a publisher twice before the first connection to it is made. rospy would then close
            # the first one: either during its handshake, so that the publisher waits for the rest of it and accepts no
            # other connection, or with a message on its way, which would be lost.
            if any(other.endpoint_id == connection.endpoint_id and _holds(other) for other in self.connections):
                return False
            return bool(super().add_connection(connection))

    def close_stalled(self) -> None:
        """Close connections whose publisher has not answered within ``STALLED``, so that rospy makes new ones."""
        latest = time.monotonic() - STALLED
        for connection in list(self.connections or ()):
            if not connection.done and connection.local_endpoint[1] is None and connection.begun < latest:
                rospy.logwarn(f"{self.resolved_name} from {connection.endpoint_id}: no answer within {STALLED:g} s")
                connection.close()

    def _connect(self, connection: Any, host: str, port: int, publisher: str, timeout: float | None = None) -> None:
        """Connect over a Unix domain socket if possible, else over TCP as rospy does."""
        if self._reader.active:
            try:
                if local_topics.connect(connection, host, port, publisher):
                    return
            except (OSError, TransportInitError) as error:
                if connection.done:
                    raise TransportInitError(f"{self.resolved_name} from {publisher}: given up") from error
                rospy.logdebug(f"{self.resolved_name} from {publisher}: {error}; connecting over TCP")
        TCPROSTransport.connect(connection, host, port, publisher, timeout)

    def _receive(self, connection: Any, callback: Any) -> None:
        """Hand the connection over to the reader, or read it in this thread, which rospy has started for it."""
        if not self._reader.active:
            TCPROSTransport.receive_loop(connection, callback)
            return
        inbox = self._inbox_of(connection)
        inbox.decode = functools.partial(self._decode, connection)
        try:
            feed = TopicFeed(connection, inbox)
        except AttributeError:
            # The connection has been closed concurrently and has lost its socket and buffer.
            connection.close()
            return
        self._reader.hand_over(feed)

    def _inbox_of(self, connection: Any) -> Inbox:
        inbox = getattr(connection, "inbox", None)
        if inbox is None:
            inbox = self.inbox(connection.callerid_pub, connection.local_endpoint[1])
            inbox.latched = connection.is_latched
            inbox.most_kept = max(self.most_foreign, FOREIGN_QUEUE)
            connection.inbox = inbox
        return inbox

    def _decode(self, connection: Any, data: bytes) -> rospy.Message | None:
        try:
            message = self._decode_bytes(data)
        except Exception as error:
            rospy.logerr(f"cannot decode a message on {self.resolved_name} from {connection.callerid_pub}: {error}")
            return None
        message._connection_header = connection.header
        if self.statistics_logger:
            self.statistics_logger.callback(message, connection.callerid_pub, connection.stat_bytes)
        return message

    def receive_callback(self, msgs: list[Any], connection: Any) -> None:
        """Store messages; called in the connection's own thread unless the reader reads it."""
        inbox = self._inbox_of(connection)
        if self.statistics_logger:
            for message in msgs:
                self.statistics_logger.callback(message, connection.callerid_pub, connection.stat_bytes)
        inbox.messages.extend(msgs)
        inbox.received += len(msgs)
        inbox.bound()
        self._reader.wake()

    def remove_connection(self, connection: Any) -> None:
        """Remove a closed connection."""
        if connection in self.connections:
            super().remove_connection(connection)
        if connection.local_endpoint[1] is not None:
            self._inbox_of(connection).closed = True
        self._reader.wake()

    def ready(self) -> list[Any]:
        """Remove and return the messages to dispatch now, by publisher's name, then in the order of sending."""
        if not self.inboxes:
            return []
        boxes = list(self.inboxes.items())  # a copy, as rospy's threads add to the dictionary
        if len(boxes) > 1:
            boxes.sort(key=lambda item: item[0])
        taken: list[Any] = []
        for key, inbox in boxes:
            if inbox.messages:
                taken += inbox.take(self.most_foreign)
            if inbox.lost or (inbox.closed and inbox.target is None and not inbox.messages):
                del self.inboxes[key]
                self._reader.inboxes_changed = True
        return taken

    def latches(self) -> list[Any]:
        """Return the latched messages dispatched so far, for another subscriber to the same topic."""
        boxes = sorted(list(self.inboxes.items()), key=lambda item: item[0])
        return [inbox.latch for _, inbox in boxes if inbox.latch is not None]


def _holds(connection: Any) -> bool:
    """Return whether a connection is being made or is open at both ends."""
    if connection.done:
        return False
    if getattr(connection, "inbox", None) is None:
        return True
    try:
        ended = select.poll()
        ended.register(connection.socket.fileno(), select.POLLRDHUP)
        return not ended.poll(0)
    except (AttributeError, ValueError):  # closed concurrently
        return False


def acquire_subscriber(name: str, data_class: type[rospy.Message], reader: Reader) -> BufferingSubscriber:
    """Return a topic's buffering end, created before rospy creates a plain one.

    Args:
        name: Topic name, resolved as usual.
        data_class: Message type.
        reader: Reads the connections of a participant.

    Raises:
        ROSException: The topic has a plain rospy.Subscriber in this process.
    """
    resolved = rospy.resolve_name(name)
    manager = rospy.topics.get_topic_manager()
    with manager.lock:
        impl = manager.subs.get(resolved)
        if impl is None:
            impl = BufferingSubscriber(resolved, data_class, reader)
            add_subscriber_impl(impl)
    if not isinstance(impl, BufferingSubscriber):
        raise rospy.ROSException(f"{resolved} has a rospy.Subscriber in this process; use lockstep.Subscriber")
    return impl
