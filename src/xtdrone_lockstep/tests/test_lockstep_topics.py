"""The connections that a participant's subscriber accepts, over real sockets; no ROS master."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from types import SimpleNamespace

import pytest

pytest.importorskip("rospy", reason="needs rospy")

import rospy
from geometry_msgs.msg import Point, PointStamped, Vector3
from rospy.impl.statistics import SubscriberStatisticsLogger
from rospy.impl.tcpros_base import TCPROSTransport
from rospy.impl.tcpros_pubsub import TCPROSSub
from std_msgs.msg import Header, String

from xtdrone_lockstep.client import topics
from xtdrone_lockstep.client.node_state import Node
from xtdrone_lockstep.transport import outlets
from xtdrone_lockstep.transport.outlets import Outlet
from xtdrone_lockstep.transport.publisher import CountingPublisher
from xtdrone_lockstep.transport.subscriber import BufferingSubscriber
from xtdrone_lockstep.transport.topic_reader import Reader

URI = "http://publisher:1"


@pytest.fixture
def subscriber(monkeypatch: pytest.MonkeyPatch) -> Iterator[BufferingSubscriber]:
    # rospy would query the master, and cache the address of the missing one for all later tests.
    monkeypatch.setattr(SubscriberStatisticsLogger, "is_enabled", lambda: False)
    reader = Reader()
    reader.activate()
    end = BufferingSubscriber("/topic", String, reader)
    yield end
    end.close()


def connection(uri: str = URI) -> TCPROSTransport:
    """Return a connection that rospy is about to make."""
    made = TCPROSTransport(TCPROSSub("/topic", String), "/topic")
    made.set_endpoint_id(uri)
    return made


def finish(made: TCPROSTransport) -> socket.socket:
    """Finish a connection's handshake and return the publisher's socket."""
    publisher, made.socket = socket.socketpair()
    made.callerid_pub, made.local_endpoint = "/publisher", ("127.0.0.1", 5)
    made.receive_loop(None)
    return publisher


def test_second_connection_is_rejected_while_the_first_is_being_made(subscriber: BufferingSubscriber) -> None:
    assert subscriber.add_connection(connection())
    assert not subscriber.add_connection(connection())
    assert subscriber.add_connection(connection("http://other:1"))


def test_late_second_connection_does_not_lose_messages_of_the_first(
    subscriber: BufferingSubscriber,
) -> None:
    first = connection()
    assert subscriber.add_connection(first)
    publisher = finish(first)
    publisher.sendall(b"\x05\0\0\0\x01\0\0\0a")
    assert not subscriber.add_connection(connection())
    inbox = subscriber.inbox("/publisher", 5)
    inbox.target = 1
    subscriber._reader.wait(0.0)
    assert inbox.fetch()
    assert [message.data for message in subscriber.ready()] == ["a"]
    publisher.close()


def test_closed_connection_is_replaced(subscriber: BufferingSubscriber) -> None:
    first = connection()
    assert subscriber.add_connection(first)
    finish(first).close()
    second = connection()
    assert subscriber.add_connection(second)
    assert subscriber.connections == [second]


class Record(SimpleNamespace):
    """Stand-in for a subscriber, or for a connection of rospy."""

    __hash__ = object.__hash__


def test_a_topic_is_declared_until_its_last_subscriber_is_removed() -> None:
    node = Node()
    changes: list[list[list[str]]] = []
    node.counter = SimpleNamespace(topics_changed=lambda: changes.append(node.declaration()["subscriptions"]))
    first, second = (Record(resolved_name="/x", type="T", impl=object()) for _ in range(2))
    node.add_subscriber(first)
    node.add_subscriber(second)
    assert changes == [[["/x", "T"]]]
    assert node.remove_subscriber(first)
    assert not node.remove_subscriber(first)
    assert node.ends == {"/x": first.impl}
    assert node.remove_subscriber(second)
    assert node.ends == {}
    assert node.declaration()["subscriptions"] == []


# ---- publishers


def transport_over(sock: socket.socket) -> Record:
    """Return the part of rospy's transport that a publisher uses."""
    return Record(
        socket=sock, endpoint_id="/subscriber", remote_endpoint=("127.0.0.1", 5), done=False, stat_num_msg=0,
        stat_bytes=0, close=lambda: None,
    )  # fmt: skip


def test_a_subscriber_that_needs_few_messages_gets_ten_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(outlets, "time", Record(monotonic=lambda: now))
    ends = socket.socketpair()
    outlet = outlets.RareOutlet("/clock", transport_over(ends[0]), 1, Node())
    for number in range(100):
        now = 100.0 + number / 64
        outlet(bytes([number]))
    assert list(ends[1].recv(1000, socket.MSG_DONTWAIT)) == list(range(0, 100, 7))
    assert outlet.count == 15
    for end in ends:
        end.close()


def test_only_announced_connections_wait_to_be_counted() -> None:
    """The counts of others have no reader: they would be kept for ever, like every subscriber of /clock."""
    ends = socket.socketpair()
    node = Node()
    outlet = Outlet("/topic", transport_over(ends[0]), 1, node)
    outlet(b"1")
    assert not node.dirty
    outlet.number = 3
    outlet(b"2")
    assert node.take_counts() == {3: 2}
    for end in ends:
        end.close()


def published(message_class: type, message: object, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """Return the messages that a subscriber receives for one message of its topic's first publisher."""
    ends = socket.socketpair()
    monkeypatch.setattr(rospy.core, "_client_ready", True)
    publisher = topics.Publisher.__new__(topics.Publisher)
    publisher.impl, publisher.data_class = CountingPublisher("/topic", message_class, Node()), message_class
    transport = transport_over(ends[0])
    publisher.impl.outlets[transport] = Outlet("/topic", transport, 1, Node())
    try:
        publisher.publish(message)
        return ends[1].recv(1000, socket.MSG_DONTWAIT)
    finally:
        for end in ends:
            end.close()


def test_published_message_has_a_sequence_number_and_a_length(monkeypatch: pytest.MonkeyPatch) -> None:
    message = PointStamped(header=Header(seq=7, stamp=rospy.Time(2, 3)))
    data = published(PointStamped, message, monkeypatch)
    assert data == struct.pack("<5I3d", 40, 1, 2, 3, 0, 0.0, 0.0, 0.0)
    assert message.header.seq == 1


def test_published_values_of_other_classes_are_written_by_genpy(monkeypatch: pytest.MonkeyPatch) -> None:
    message = PointStamped(header=Header(frame_id="a"), point=Vector3(1.0, 2.0, 3.0))
    data = published(PointStamped, message, monkeypatch)
    assert data == struct.pack("<5Ic3d", 41, 1, 0, 0, 1, b"a", 1.0, 2.0, 3.0)


def test_publishing_a_wrong_value_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(rospy.ROSSerializationException, match=r"field point\.x must be float type"):
        published(PointStamped, PointStamped(point=Point(x="far")), monkeypatch)
    with pytest.raises(TypeError, match="expected"):
        published(PointStamped, Point(), monkeypatch)


def test_a_connection_that_ends_after_the_topic_was_closed_is_removed() -> None:
    ends = socket.socketpair()
    impl = CountingPublisher("/topic", PointStamped, Node())
    transport = transport_over(ends[0])
    transport.fileno, transport.close = ends[0].fileno, ends[0].close
    impl.close()
    impl.outlets[transport] = outlet = Outlet("/topic", transport, 1, Node())  # as a thread that is adding it
    impl.remove_connection(transport)
    assert outlet.closed
    assert not impl.outlets
    for end in ends:
        end.close()
