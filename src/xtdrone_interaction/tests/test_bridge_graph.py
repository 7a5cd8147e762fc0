"""How often a bridge reads the ROS graph, with a clock set by the test."""

from __future__ import annotations

import pytest

pytest.importorskip("rospy")

from xtdrone_interaction.bridges.bridge_graph import LONGEST, SHARE, BridgeGraph
from xtdrone_interaction.topics.discovery import TopicGraph


@pytest.mark.parametrize(("takes", "period"), [(0.001, 1.0), (0.06, 0.06 / SHARE), (9.0, LONGEST)])
def test_a_large_graph_is_read_more_rarely(takes: float, period: float) -> None:
    now, read = [0.0], []

    def read_topics(_uri: str) -> TopicGraph:
        read.append(now[0])
        now[0] += takes
        return TopicGraph({}, {})

    graph = BridgeGraph("http://127.0.0.1:9", ("*",), 1.0, lambda: now[0], read_topics)
    graph.read()
    now[0] = takes + period - 0.01
    graph.read()
    assert read == [0.0]
    now[0] = takes + period
    graph.read()
    assert len(read) == 2
