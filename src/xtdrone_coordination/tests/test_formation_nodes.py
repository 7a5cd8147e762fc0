"""Pattern and topology in leader and follower nodes after a time reset, on topics of this test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rospy")

from geometry_msgs.msg import Vector3
from std_msgs.msg import Float32MultiArray, Float64MultiArray, Int32MultiArray, String

from xtdrone_coordination import follower_nodes
from xtdrone_coordination.follower import Follower, FollowerOptions
from xtdrone_coordination.follower_nodes import PATTERN_TOPIC, TOPOLOGY_TOPIC, FollowerNode
from xtdrone_coordination.known_swarm_state import ArraySwarm, SwarmState
from xtdrone_coordination.leader import Leader
from xtdrone_coordination.leader_node import LeaderNode
from xtdrone_coordination.patterns import Patterns


class Graph:
    """Topics without a master.

    Attributes:
        said: published messages by topic.
        callbacks: by topic.
        hooks: called when time is set back.
    """

    def __init__(self) -> None:
        self.said: dict[str, list[Any]] = {}
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.hooks: list[Callable[[], None]] = []

    def publisher(self, topic: str, kind: type, **_: object) -> Any:
        class Publisher:
            publish = self.said.setdefault(topic, []).append

        return Publisher

    def subscriber(self, topic: str, kind: type, callback: Callable[[Any], None]) -> None:
        self.callbacks[topic] = callback

    def pattern(self, *data: float) -> None:
        self.callbacks[PATTERN_TOPIC](Float32MultiArray(data=data))

    def topology(self, *data: int) -> None:
        self.callbacks[TOPOLOGY_TOPIC](Int32MultiArray(data=data))


class Recorder:
    """A publisher that copies its messages, since nodes reuse one message."""

    def __init__(self, messages: list[str]) -> None:
        self._messages = messages

    def publish(self, message: Any) -> None:
        self._messages.append(str(message))


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    graph = Graph()
    for name, value in (
        ("Publisher", graph.publisher),
        ("Subscriber", graph.subscriber),
        ("add_reset_hook", graph.hooks.append),
    ):
        monkeypatch.setattr(follower_nodes.lockstep, name, value, raising=False)
    monkeypatch.setattr(follower_nodes.rospy, "get_param", lambda name, default: default)
    return graph


def test_followers_ignore_messages_latched_before_a_time_reset(graph: Graph) -> None:
    follower = Follower(1, 3)
    node = FollowerNode("iris", [follower])
    offsets, listeners = (3.0, 0.0, 0.0, 3.0, 0.0, 0.0), (0, 0, 0, 1, 0, 0, 1, 1, 0)
    for _ in range(2):
        graph.pattern(*offsets)
        graph.topology(*listeners)
        node.step()
        assert follower.offsets == [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 3.0, 0.0)]
        for hook in graph.hooks:
            hook()
        graph.pattern(*offsets)
        graph.topology(*listeners)
        assert follower.offsets is None
        node.step()


def test_an_empty_pattern_is_invalid(graph: Graph) -> None:
    follower = Follower(1, 3)
    FollowerNode("iris", [follower])
    graph.pattern()
    graph.topology()
    graph.topology(0, 0, 0, 0, 0, 5, 0, 0, 0)
    graph.pattern(3.0, 0.0, 0.0, 3.0, 0.0, 0.0)
    assert follower.offsets is not None
    assert follower.weights == {2: 5.0}
    graph.pattern()
    graph.topology()
    assert follower.offsets is None
    assert follower.weights == {0: 1.0}


@pytest.mark.parametrize("count", [3, follower_nodes.MANY + 1])
def test_an_avoidance_node_that_dies_is_replaced_until_it_speaks_again(graph: Graph, count: int) -> None:
    """The timeout is a second of turns, in single followers and in a batch."""
    swarm = follower_nodes.make_swarm(count, count - 1)
    warnings: list[str] = []
    options = FollowerOptions(avoid="topic")
    followers = [Follower(i, count, swarm=swarm, options=options, warn=warnings.append) for i in range(1, count)]
    news: list[str] = []
    followers[0].info = news.append
    node = FollowerNode("iris", followers)
    places = Patterns(count).offsets("origin")
    graph.pattern(*places.T.ravel())
    told = (0.0, 0.0, 0.25)

    def turn(spoken: bool) -> bool:
        """Return whether the first follower uses the output of the avoidance node."""
        for i, place in enumerate([(0.0, 0.0, 0.0), *map(tuple, places.tolist())]):
            swarm.on_position(i, place)
        for follower in followers:
            if spoken:
                graph.callbacks[f"/xtdrone/iris_{follower.id}/avoid_vel"](Vector3(*told))
        node.step()
        return followers[0].avoidance_vector == told

    assert all(turn(True) for _ in range(5))
    used = [turn(False) for _ in range(40)]
    assert used == [True] * 30 + [False] * 10
    assert len(warnings) == count - 1
    assert turn(True)
    assert len(news) == 1
    for hook in graph.hooks:
        hook()
    assert (len(warnings), len(news)) == (count - 1, 1)


def test_followers_of_a_process_in_a_batch_publish_the_same(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        follower_nodes.rospy, "get_param", lambda name, default: "/swarm" if "swarm" in name else default
    )
    assert [type(follower_nodes.make_swarm(40, n)) for n in (1, follower_nodes.MANY - 1, follower_nodes.MANY)] == [
        SwarmState,
        SwarmState,
        ArraySwarm,
    ]
    rng = np.random.default_rng(1)
    places = [Float64MultiArray(data=rng.normal(size=(40, 6)).ravel()) for _ in range(3)]
    offsets = Patterns(40).offsets("cube")
    said = []
    for swarm in (SwarmState(40), ArraySwarm(40)):
        node = FollowerNode("iris", [Follower(i, 40, swarm=swarm) for i in range(1, 40)])
        messages: list[str] = []
        for topics in (node._commands, node._avoidances):
            for i in topics:
                monkeypatch.setitem(topics, i, Recorder(messages))
        graph.pattern(*offsets.T.ravel())
        for place in places:
            graph.callbacks["/swarm"](place)
            node.step()
            graph.topology(*np.eye(40, k=-1, dtype=int).ravel())
        said.append(messages)
    assert len(said[0]) == 3 * 2 * 39
    assert said[0] == said[1]


def test_the_leader_withdraws_its_latched_messages(graph: Graph) -> None:
    leader = Leader(3)
    node = LeaderNode("iris", leader, republish_rate=10)
    (restart,) = graph.hooks
    restart()
    assert graph.said[PATTERN_TOPIC] == graph.said[TOPOLOGY_TOPIC] == []  # nothing was latched
    flights = []
    for _ in range(2):
        said = [graph.said[topic] for topic in (PATTERN_TOPIC, TOPOLOGY_TOPIC)]
        for messages in said:
            messages.clear()
        node.step()
        node.step()
        graph.callbacks["/xtdrone/leader/cmd"](String(data="cube"))
        counts = []
        for _ in range(8):
            node.step()
            counts.append(len(said[0]))
        flights.append((counts, [list(messages) for messages in said]))
        restart()
        assert [list(messages[-1].data) for messages in said] == [[], []]
        assert (leader.pattern, leader.offsets) == ("", None)
    assert flights[0][0] == [1, 1, 1, 2, 2, 2, 3, 3]
    assert flights[1] == flights[0]


def test_a_follower_without_neighbours_is_reported(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(follower_nodes.rospy, "logwarn", said.append)
    node = FollowerNode("iris", [Follower(1, 3)])
    for _ in range(3):
        graph.topology(0, 0, 0, 0, 0, 0, 1, 1, 0)
        node.step()
    assert said == ["/xtdrone/communication_topology: no neighbours for vehicle 1: vehicle 0 is added"]
    graph.topology(0, 0, 0, 1, 0, 0, 0, 0, 0)
    assert len(said) == 1, "vehicle 2 is another node's"
