"""Topics of any type on a ROS master: one subscription for all listeners, at rates of their own."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import rospy
from conftest import Graph, poll
from geometry_msgs.msg import PointStamped
from std_msgs.msg import String

from xtdrone_interaction.topics.discovery import MasterError, read_topics
from xtdrone_interaction.topics.raw_subscriptions import RawMessage, RawSubscriptions

TOPIC = "/tried/point"


class Kept:
    """A callback that keeps its messages."""

    def __init__(self) -> None:
        self.messages: list[RawMessage] = []
        self.threads: set[str] = set()

    def __call__(self, message: RawMessage) -> None:
        self.messages.append(message)
        self.threads.add(threading.current_thread().name)

    @property
    def values(self) -> list[float]:
        return [message.message.point.x for message in self.messages]


@pytest.fixture
def subscriptions() -> Iterator[RawSubscriptions]:
    made = RawSubscriptions()
    yield made
    made.close()


def test_listeners_share_one_subscription_and_get_messages_at_their_own_rate(
    graph: Graph, subscriptions: RawSubscriptions
) -> None:
    every, few = Kept(), Kept()
    first = subscriptions.listen(TOPIC, every)
    second = subscriptions.listen("tried/point", few, most=1.0)
    for i in range(50):
        message = PointStamped()
        message.point.x = i
        graph.say(TOPIC, message)
    poll(lambda: len(every.messages) == 50, "all messages")
    assert every.values == list(range(50))
    poll(lambda: few.values[-1:] == [49.0], "the last one, after its time")
    assert few.values[0] == 0.0
    assert len(few.values) <= 3
    assert every.messages[-1].message is few.messages[-1].message
    assert every.messages[0].type == "geometry_msgs/PointStamped"
    assert "float64 x" in every.messages[0].definition
    assert subscriptions.rates()[TOPIC][0] > 10.0
    mine = read_topics(graph.uri).topics[TOPIC]
    assert mine.subscribers == (rospy.get_name(),)
    first.close()
    assert TOPIC in subscriptions.rates()
    second.close()
    second.close()
    assert not subscriptions.rates()
    assert not read_topics(graph.uri).topics[TOPIC].subscribers


def test_a_latched_message_reaches_a_later_listener(graph: Graph, subscriptions: RawSubscriptions) -> None:
    publisher = rospy.Publisher("/tried/latched", String, queue_size=1, latch=True)
    publisher.publish(String("kept"))
    early, late = Kept(), Kept()
    subscriptions.listen("/tried/latched", early)
    poll(lambda: early.messages, "the latched message")
    subscriptions.listen("/tried/latched", late)
    assert [message.message.data for message in late.messages] == ["kept"]
    publisher.unregister()


def test_names_and_masters_that_are_none_are_refused(graph: Graph, subscriptions: RawSubscriptions) -> None:
    for name in ("", "/", "a b", "/é", "x" * 5 + "-"):
        with pytest.raises(ValueError, match="is not allowed, a name such as"):
            subscriptions.listen(name, Kept())
    with pytest.raises(MasterError, match="does not answer"):
        read_topics("http://127.0.0.1:9")
