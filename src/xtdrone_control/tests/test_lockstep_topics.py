"""Which connections a participant's subscriber keeps, over real sockets; no ROS master."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

pytest.importorskip("rospy", reason="needs rospy")

from rospy.impl.statistics import SubscriberStatisticsLogger
from rospy.impl.tcpros_base import TCPROSTransport
from rospy.impl.tcpros_pubsub import TCPROSSub
from std_msgs.msg import String

from xtdrone_control.lockstep.reader import Reader
from xtdrone_control.lockstep.topics import BufferingSubscriber

URI = "http://publisher:1"


@pytest.fixture
def subscriber(monkeypatch: pytest.MonkeyPatch) -> Iterator[BufferingSubscriber]:
    # rospy would ask the master, and keep the address of that which is not there for all tests to come.
    monkeypatch.setattr(SubscriberStatisticsLogger, "is_enabled", lambda: False)
    reader = Reader()
    reader.activate()
    end = BufferingSubscriber("/topic", String, reader)
    yield end
    end.close()


def connection(uri: str = URI) -> TCPROSTransport:
    """One that rospy is about to make."""
    made = TCPROSTransport(TCPROSSub("/topic", String), "/topic")
    made.set_endpoint_id(uri)
    return made


def finish(made: TCPROSTransport) -> socket.socket:
    """Have a connection's handshake end, and return the publisher's socket."""
    publisher, made.socket = socket.socketpair()
    made.callerid_pub, made.local_endpoint = "/publisher", ("127.0.0.1", 5)
    made.receive_loop(None)
    return publisher


def test_a_second_connection_to_a_publisher_is_refused_while_the_first_is_made(subscriber: BufferingSubscriber) -> None:
    assert subscriber.add_connection(connection())
    assert not subscriber.add_connection(connection())
    assert subscriber.add_connection(connection("http://other:1"))


def test_a_second_connection_that_comes_late_does_not_cost_the_first_its_messages(
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


def test_a_publisher_that_has_closed_its_connection_gets_another(subscriber: BufferingSubscriber) -> None:
    first = connection()
    assert subscriber.add_connection(first)
    finish(first).close()
    second = connection()
    assert subscriber.add_connection(second)
    assert subscriber.connections == [second]
