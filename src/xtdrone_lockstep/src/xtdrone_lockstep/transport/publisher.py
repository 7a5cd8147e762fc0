"""A topic's publishing end that counts the messages of each connection."""

from __future__ import annotations

import socket
from collections.abc import Collection
from io import BytesIO
from typing import Any

import rospy
import rospy.topics
from rospy.msg import serialize_message

from xtdrone_lockstep.ros_codec import compile_class

from ..protocol import Digest
from .outlets import Ledger, Outlet, RareOutlet
from .rospy_internals import PublisherImpl, add_publisher_impl


class CountingPublisher(PublisherImpl):
    """A topic's publishing end whose connections are ``Outlet`` objects.

    Attributes:
        outlets: The outlets by rospy's connection.
        rare: Names of the subscribers that get ``RareOutlet`` objects.
    """

    def __init__(self, name: str, data_class: type[rospy.Message], ledger: Ledger) -> None:
        super().__init__(name, data_class)
        codec = compile_class(data_class)
        self._packet = None if codec is None else codec.packet
        self.outlets: dict[Any, Outlet] = {}
        self.rare: Collection[str] = ()
        self._stall_size: int | None = None
        self._ledger = ledger

    def set_queue_size(self, queue_size: int) -> None:
        """Set the number of messages kept for a stalled subscriber; rospy's queues and their threads are not used."""
        self._stall_size = queue_size

    def add_connection(self, connection: Any) -> bool:
        """Add a connection and count from its first message (a latched one included)."""
        connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        kind = RareOutlet if connection.endpoint_id in self.rare else Outlet
        outlet = kind(self.resolved_name, connection, self._stall_size, self._ledger)
        connection.write_data = outlet
        # The publishing lock keeps messages from being sent between the connection and its announcement.
        with self.publock:
            self.outlets[connection] = outlet
            added = bool(super().add_connection(connection))
            if added:
                self._ledger.outlet_made(outlet)
            else:
                del self.outlets[connection]
        return added

    def publish(self, message: rospy.Message, connection_override: Any = None) -> bool | None:
        """Serialise a message once and send it over all connections, or over one.

        Args:
            message: The message; its header's sequence number is set.
            connection_override: The only connection to send it over; None for all.

        Returns:
            Whether it was sent.

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
            # The sequence number must not depend on when subscribers connect: it advances without subscribers too, but
            # not when a latched message is sent again to a new connection.
            if connection_override is None or message is not self.latch:
                self.seq += 1
            digests = self._ledger.digests
            if not outlets and digests is None:
                return False
            try:
                data = self._encode(buffer, message)
            except ValueError:
                if not self.closed:
                    raise
                # Closed concurrently by another thread, or by a signal handler in this one.
                return super().publish(message, connection_override)
            if digests is not None and connection_override is None:
                digest = digests.get(self.resolved_name)
                if digest is None:
                    digest = digests[self.resolved_name] = Digest()
                digest.add(self._ledger.time_us, memoryview(data)[4:])
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

    def compiled_outlets(self) -> list[Outlet] | None:
        """Return the connections over which compiled code may send now; None if only ``publish`` can."""
        outlets = list(self.outlets.values())
        plain = all(type(outlet) is Outlet and outlet.number and outlet.sock is not None for outlet in outlets)
        return None if self.closed or self.is_latch or not plain else outlets

    def record(self, count: int, size: int) -> None:
        """Record messages that compiled code has published: their number and bytes."""
        self.seq += count
        self.message_data_sent += size

    def _encode(self, buffer: BytesIO, message: rospy.Message) -> bytes:
        data = None if self._packet is None else self._packet(message, self.seq)
        if data is not None:
            return data
        buffer.seek(0)
        buffer.truncate(0)
        serialize_message(buffer, self.seq, message)
        return buffer.getvalue()

    def remove_connection(self, connection: Any) -> None:
        """Remove a closed connection."""
        outlet = self.outlets.pop(connection, None)
        if outlet is None:
            return
        outlet.closed = True
        try:
            super().remove_connection(connection)
        except TypeError:
            if self.subscriber_listeners is not None:  # else rospy's close, in another thread, has taken them away
                raise
        self._ledger.outlet_lost(outlet)


def acquire_publisher(name: str, data_class: type[rospy.Message], latch: bool, ledger: Ledger) -> CountingPublisher:
    """Return a topic's counting end, created before rospy creates a plain one.

    Args:
        name: Topic name, resolved as usual.
        data_class: Message type.
        latch: Whether to send the last message to every new subscriber.
        ledger: Records the counts.

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
            add_publisher_impl(impl)
    if not isinstance(impl, CountingPublisher):
        raise rospy.ROSException(f"{resolved} has a rospy.Publisher in this process; use lockstep.Publisher")
    return impl
