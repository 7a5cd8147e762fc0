"""rospy's topics with what the lockstep needs: counted connections, and messages that wait for their tick.

A publisher never blocks and never hands a message to another thread while its subscribers keep up: the bytes are in the
kernel when `publish` returns. A subscriber's messages are kept per connection; the node's own thread takes them.
"""

from __future__ import annotations

import functools
import select
import socket
import threading
from collections import deque
from typing import Any, Protocol

import rospy
import rospy.topics
from rospy.impl.registration import Registration
from rospy.impl.tcpros_base import TCPROSTransport
from rospy.msg import serialize_message

from .protocol import Digest
from .reader import FOREIGN_QUEUE, Feed, Inbox, Reader

STALLED_QUEUE = 100
"""Messages kept for a stalled subscriber that is no participant, when the publisher names no queue size."""


class Ledger(Protocol):
    """Who is told of connections and messages, see `client`."""

    dirty: deque[Outlet]
    digests: dict[str, Digest] | None
    """What has been published by topic, condensed; None if nobody wants to know."""
    time_us: int
    """The simulation time in microseconds, for the digests."""

    def outlet_made(self, outlet: Outlet) -> None:
        """A subscriber has connected; called in a thread of rospy's."""

    def outlet_lost(self, outlet: Outlet) -> None:
        """A subscriber's connection is closed; called in any thread."""


class Outlet:
    """The sending end of one topic connection; takes the place of a rospy transport's `write_data`.

    Attributes:
        topic: Resolved topic name.
        peer: The subscriber's name.
        port: The subscriber's TCP port.
        count: Messages handed over since the connection was made.
        number: The channel's number in this process, from 1; 0 until it was announced.
        dirty: True while it waits in the ledger for its count to be sent.
        closed: True when the connection is no more.
        participant: True if the subscriber is one; what it cannot take at once is then kept without a bound.
    """

    def __init__(self, topic: str, transport: Any, queue_size: int | None, ledger: Ledger) -> None:
        """Wraps one connection.

        Args:
            topic: Resolved topic name.
            transport: rospy's TCPROSTransport, connected.
            queue_size: Messages kept when a subscriber that is no participant stalls.
            ledger: Is told of each message.
        """
        self.topic = topic
        self.peer: str = transport.endpoint_id
        self.port: int = transport.remote_endpoint[1]
        self.count = 0
        self.number = 0
        self.dirty = False
        self.closed = False
        self.participant = False
        self._transport = transport
        self._queue_size = queue_size or STALLED_QUEUE
        self._ledger = ledger
        self._lock = threading.Lock()
        self._backlog: deque[bytes] = deque()
        self._draining = False

    def __call__(self, data: bytes) -> bool:
        """Sends one serialised message without blocking; the caller holds the topic's publishing lock.

        Args:
            data: Length-prefixed message.

        Returns:
            True, as rospy's `write_data`.

        Raises:
            TransportTerminated: The connection is closed.
        """
        transport = self._transport
        # Without the drain thread nobody else sends, and only a sender under the publishing lock starts one.
        if not self._draining or not self._keep(data):
            self._send(transport, data)
        self.count += 1
        transport.stat_num_msg += 1
        transport.stat_bytes += len(data)
        if not self.dirty:
            self.dirty = True
            self._ledger.dirty.append(self)
        return True

    def _send(self, transport: Any, data: bytes) -> None:
        sock = transport.socket
        if sock is None or transport.done:
            raise rospy.exceptions.TransportTerminated("connection closed")
        try:
            sent = sock.send(data, socket.MSG_DONTWAIT)
        except BlockingIOError:
            sent = 0
        except OSError as error:
            transport.close()
            raise rospy.exceptions.TransportTerminated(str(error)) from error
        if sent == len(data):
            return
        # The subscriber does not keep up: a thread sends the rest, so that this node does not stand still with it.
        self._draining = True
        self._backlog.append(data[sent:])
        threading.Thread(target=self._drain, args=(sock,), name=f"drain {self.topic}", daemon=True).start()

    def _keep(self, data: bytes) -> bool:
        """Leaves a message to the thread that sends; returns False if that has just ended."""
        with self._lock:
            if not self._draining:
                return False
            # The first entry may be the rest of a message that is half sent: never drop that.
            if not self.participant and len(self._backlog) > self._queue_size:
                del self._backlog[1]
                self.count -= 1
            self._backlog.append(data)
            return True

    def _drain(self, sock: socket.socket) -> None:
        while True:
            with self._lock:
                if not self._backlog:
                    self._draining = False
                    return
                data = self._backlog[0]
            try:
                sock.sendall(data)
            except OSError:
                self._transport.close()
                return
            with self._lock:
                self._backlog.popleft()


class CountingPublisher(rospy.topics._PublisherImpl):
    """A topic's publishing end whose connections are outlets."""

    def __init__(self, name: str, data_class: type[rospy.Message], ledger: Ledger) -> None:
        """As rospy's, plus the ledger."""
        super().__init__(name, data_class)
        self.outlets: dict[Any, Outlet] = {}
        self._stall_size: int | None = None
        self._ledger = ledger

    def set_queue_size(self, queue_size: int) -> None:
        """Sets how much is kept for a subscriber that stalls; rospy's queues and their threads are not used."""
        self._stall_size = queue_size

    def add_connection(self, connection: Any) -> bool:
        """Starts counting with the connection's first message (a latched one included)."""
        connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        outlet = Outlet(self.resolved_name, connection, self._stall_size, self._ledger)
        connection.write_data = outlet
        # Under the publishing lock no message of the node's thread comes between the connection and its announcement.
        with self.publock:
            self.outlets[connection] = outlet
            added = bool(super().add_connection(connection))
            if added:
                self._ledger.outlet_made(outlet)
            else:
                del self.outlets[connection]
        return added

    def publish(self, message: rospy.Message, connection_override: Any = None) -> bool | None:
        """Serialises a message once and sends it over every connection, or over one; as rospy's, with less in between.

        Raises:
            SerializationError: The message cannot be serialised.
            ROSException: The topic is closed.
        """
        lock, buffer = self.publock, self.buff
        if self.closed or lock is None or buffer is None:
            return super().publish(message, connection_override)
        with lock:
            if self.is_latch:
                self.latch = message
            if connection_override is not None:
                outlets = [(connection_override, connection_override.write_data)]
            else:
                outlets = list(self.outlets.items())
            if rospy.core.is_shutdown():
                return False
            # Also if nobody listens, and not for a latched message that is sent to a new connection once more: so the
            # number does not depend on who connects when.
            if connection_override is None or message is not self.latch:
                self.seq += 1
            digests = self._ledger.digests
            if not outlets and digests is None:
                return False
            try:
                buffer.seek(0)
                buffer.truncate(0)
                serialize_message(buffer, self.seq, message)
                data = buffer.getvalue()
            except ValueError:
                if not self.closed:
                    raise
                # Closed just now by another thread, or by a signal handler on top of this one.
                return super().publish(message, connection_override)
            if digests is not None and connection_override is None:
                digests.setdefault(self.resolved_name, Digest()).add(self._ledger.time_us, memoryview(data)[4:])
            self.message_data_sent += len(data)
            ended = []
            for connection, send in outlets:
                try:
                    send(data)
                except rospy.exceptions.TransportTerminated:
                    ended.append(connection)
            for connection in ended:
                connection.close()
        return True

    def remove_connection(self, connection: Any) -> None:
        """Takes a closed connection out, once."""
        outlet = self.outlets.pop(connection, None)
        if outlet is None:
            return
        outlet.closed = True
        super().remove_connection(connection)
        self._ledger.outlet_lost(outlet)


class BufferingSubscriber(rospy.topics._SubscriberImpl):
    """A topic's receiving end that keeps messages until `ready` is called.

    In a participant the connections are read by `Reader`, in the node's own thread; else by rospy's threads.
    """

    def __init__(self, name: str, data_class: type[rospy.Message], reader: Reader) -> None:
        """As rospy's, plus the reader of the connections."""
        super().__init__(name, data_class)
        self.tcp_nodelay = True
        self.inboxes: dict[tuple[str, int], Inbox] = {}
        self.most_foreign = FOREIGN_QUEUE
        self._reader = reader

    def inbox(self, publisher: str, port: int) -> Inbox:
        """Returns the inbox of one connection, made if need be.

        Args:
            publisher: The publisher's name.
            port: This process's TCP port of the connection.
        """
        return self.inboxes.setdefault((publisher, port), Inbox(publisher))

    def set_queue_size(self, queue_size: int | None) -> None:
        """Bounds what is kept of foreign publishers; what participants send is counted and never dropped.

        Raises:
            ROSException: It is no positive integer.
        """
        if queue_size is None:
            return
        if not isinstance(queue_size, int) or queue_size < 1:
            raise rospy.ROSException(f"{self.resolved_name}: queue_size {queue_size!r} must be a positive integer")
        self.most_foreign = queue_size

    def add_connection(self, connection: Any) -> bool:
        """Sees to it that a connection is handed over when it is made: rospy then calls its `receive_loop`."""
        connection.receive_loop = functools.partial(self._receive, connection)
        with self.c_lock:
            # The master may name a publisher twice before the first connection to it is made, and the second comes
            # later. rospy would close the first: in the middle of its handshake, for whose end the publisher then waits
            # and accepts no other, or when a message is already under way, which would be lost.
            if any(other.endpoint_id == connection.endpoint_id and _holds(other) for other in self.connections):
                return False
            return bool(super().add_connection(connection))

    def _receive(self, connection: Any, callback: Any) -> None:
        """Hands the connection over, or reads it in this thread of rospy's, which is the connection's own."""
        if not self._reader.active:
            TCPROSTransport.receive_loop(connection, callback)
            return
        inbox = self._inbox_of(connection)
        inbox.decode = functools.partial(self._decode, connection)
        try:
            feed = Feed(connection, inbox)
        except AttributeError:
            # The connection was closed just now: it has neither a socket nor a buffer any more.
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
            message = self.data_class().deserialize(data)
        except Exception as error:
            rospy.logerr(f"a message on {self.resolved_name} from {connection.callerid_pub} cannot be read: {error}")
            return None
        message._connection_header = connection.header
        if self.statistics_logger:
            self.statistics_logger.callback(message, connection.callerid_pub, connection.stat_bytes)
        return message

    def receive_callback(self, msgs: list[Any], connection: Any) -> None:
        """Keeps the messages; called in the connection's own thread if the reader does not read it."""
        inbox = self._inbox_of(connection)
        if self.statistics_logger:
            for message in msgs:
                self.statistics_logger.callback(message, connection.callerid_pub, connection.stat_bytes)
        inbox.messages.extend(msgs)
        inbox.received += len(msgs)
        inbox.bound()
        self._reader.wake()

    def remove_connection(self, connection: Any) -> None:
        """Takes a closed connection out; nothing more will come over it."""
        if connection in self.connections:
            super().remove_connection(connection)
        if connection.local_endpoint[1] is not None:
            self._inbox_of(connection).closed = True
        self._reader.wake()

    def ready(self) -> list[Any]:
        """Returns and removes the messages whose tick it is: by publisher's name, then in the order of sending."""
        if not self.inboxes:
            return []
        boxes = list(self.inboxes.items())  # rospy's threads add to the dictionary
        if len(boxes) > 1:
            boxes.sort(key=lambda item: item[0])
        taken: list[Any] = []
        for key, inbox in boxes:
            taken += inbox.take(self.most_foreign)
            if inbox.lost or (inbox.closed and inbox.target is None and not inbox.messages):
                del self.inboxes[key]
        return taken

    def latches(self) -> list[Any]:
        """Returns the latched messages dispatched so far, for a subscriber that comes later to the same topic."""
        boxes = sorted(list(self.inboxes.items()), key=lambda item: item[0])
        return [inbox.latch for _, inbox in boxes if inbox.latch is not None]


def _holds(connection: Any) -> bool:
    """Says whether a subscriber's connection is being made, or is made and its publisher has not closed it."""
    if connection.done:
        return False
    if getattr(connection, "inbox", None) is None:
        return True
    try:
        ended = select.poll()
        ended.register(connection.socket.fileno(), select.POLLRDHUP)
        return not ended.poll(0)
    except (AttributeError, ValueError):  # closed just now, in another thread
        return False


def acquire_publisher(name: str, data_class: type[rospy.Message], latch: bool, ledger: Ledger) -> CountingPublisher:
    """Makes (or finds) the counting end of a topic before rospy can make a plain one.

    Raises:
        ROSException: The topic is advertised in this process by a plain rospy.Publisher.
    """
    resolved = rospy.resolve_name(name)
    manager = rospy.topics.get_topic_manager()
    with manager.lock:
        impl = manager.pubs.get(resolved)
        if impl is None:
            impl = CountingPublisher(resolved, data_class, ledger)
            if latch:
                impl.enable_latch()
            manager._add(impl, manager.pubs, Registration.PUB)
    if not isinstance(impl, CountingPublisher):
        raise rospy.ROSException(f"{resolved} is advertised by a rospy.Publisher here; use lockstep.Publisher for both")
    return impl


def acquire_subscriber(name: str, data_class: type[rospy.Message], reader: Reader) -> BufferingSubscriber:
    """Makes (or finds) the buffering end of a topic before rospy can make a plain one.

    Raises:
        ROSException: The topic is subscribed to in this process by a plain rospy.Subscriber.
    """
    resolved = rospy.resolve_name(name)
    manager = rospy.topics.get_topic_manager()
    with manager.lock:
        impl = manager.subs.get(resolved)
        if impl is None:
            impl = BufferingSubscriber(resolved, data_class, reader)
            manager._add(impl, manager.subs, Registration.SUB)
    if not isinstance(impl, BufferingSubscriber):
        raise rospy.ROSException(f"{resolved} has a rospy.Subscriber here; use lockstep.Subscriber for both")
    return impl
