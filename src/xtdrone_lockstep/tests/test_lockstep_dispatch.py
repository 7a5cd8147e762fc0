"""The order and completeness of a turn's callbacks; no ROS master."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import pytest

pytest.importorskip("rospy", reason="needs rospy")

from rospy.impl.statistics import SubscriberStatisticsLogger
from std_msgs.msg import String

from xtdrone_lockstep.client.node_state import Node
from xtdrone_lockstep.transport.subscriber import BufferingSubscriber


class _Subscription(SimpleNamespace):
    """A subscriber as its node sees it."""

    __hash__ = object.__hash__


class _Participant:
    """A node with subscribers, and the messages that they receive.

    Attributes:
        node: the node.
        received: name of the subscriber and message.
    """

    def __init__(self) -> None:
        self.node = Node()
        self.received: list[tuple[str, str]] = []

    def end(self, topic: str) -> BufferingSubscriber:
        """Return the receiving end of a topic."""
        return BufferingSubscriber(topic, String, self.node.reader)

    def subscribe(self, name: str, end: BufferingSubscriber) -> _Subscription:
        """Declare a subscriber of this name."""
        invoke = partial(lambda name, message: self.received.append((name, message)), name)
        made = _Subscription(resolved_name=end.resolved_name, type="T", impl=end, pending=[], invoke=invoke)
        self.node.add_subscriber(made)
        return made


@pytest.fixture
def participant(monkeypatch: pytest.MonkeyPatch) -> _Participant:
    monkeypatch.setattr(SubscriberStatisticsLogger, "is_enabled", lambda: False)  # would query the master
    return _Participant()


def send(end: BufferingSubscriber, text: str, *, lost: bool = False) -> None:
    """Deliver the only message of a new connection, which is lost afterwards or not."""
    inbox = end.inbox(f"/publisher_of_{text}", 5)
    inbox.messages.append(text)
    inbox.received = inbox.target = 1
    inbox.lost = lost


def test_callbacks_run_in_the_order_of_declaration_whatever_connects_first(participant: _Participant) -> None:
    first, second, third = map(participant.end, ("/a", "/b", "/c"))
    for name, end in (("first", first), ("second", second), ("third", third)):
        participant.subscribe(name, end)
    participant.node.dispatch()
    send(third, "x")
    participant.node.dispatch()
    send(second, "y")
    send(first, "z")
    participant.node.dispatch()
    assert participant.received == [("third", "x"), ("first", "z"), ("second", "y")]


def test_all_subscribers_of_a_topic_receive_the_last_message_of_a_lost_connection(participant: _Participant) -> None:
    end = participant.end("/a")
    participant.subscribe("first", end)
    participant.subscribe("second", end)
    send(end, "x", lost=True)
    participant.node.dispatch()
    participant.node.dispatch()
    assert participant.received == [("first", "x"), ("second", "x")]


def test_a_removed_subscriber_receives_nothing(participant: _Participant) -> None:
    end = participant.end("/a")
    removed = participant.subscribe("removed", end)
    participant.subscribe("kept", end)
    send(end, "x")
    participant.node.remove_subscriber(removed)
    participant.node.dispatch()
    assert participant.received == [("kept", "x")]


def test_a_latched_message_is_received_by_a_late_subscriber(participant: _Participant) -> None:
    end = participant.end("/a")
    participant.node.dispatch()
    late = participant.subscribe("late", end)
    late.pending = ["x"]
    participant.node.dispatch()
    participant.node.dispatch()
    assert participant.received == [("late", "x")]


def test_only_topics_with_messages_or_ended_connections_are_asked_for_messages(
    participant: _Participant, monkeypatch: pytest.MonkeyPatch
) -> None:
    busy, quiet, ended = map(participant.end, ("/a", "/b", "/c"))
    asked: list[str] = []
    ready = BufferingSubscriber.ready
    monkeypatch.setattr(BufferingSubscriber, "ready", lambda end: (asked.append(end.resolved_name), ready(end))[1])
    for name, end in (("busy", busy), ("quiet", quiet), ("ended", ended)):
        participant.subscribe(name, end)
    send(busy, "x")
    quiet.inbox("/publisher", 5).target = 0
    ended.inbox("/publisher", 5).closed = True
    participant.node.dispatch()
    participant.node.dispatch()
    assert asked == ["/a", "/c"]
    assert not ended.inboxes
    assert participant.received == [("busy", "x")]
