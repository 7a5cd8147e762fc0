"""The nodes that publish and subscribe to each topic and offer each service, as Foxglove's Topic Graph shows them."""

from __future__ import annotations

from collections.abc import Callable

from foxglove import ConnectionGraph

from xtdrone_interaction.topics.discovery import TopicGraph


def to_connection_graph(graph: TopicGraph, is_open: Callable[[str], bool]) -> ConnectionGraph:
    """Return a graph for the server.

    Args:
        graph: topics and services to show.
        is_open: returns whether a service is to be shown.
    """
    made = ConnectionGraph()
    for topic in graph.topics.values():
        if topic.publishers:
            made.set_published_topic(topic.name, list(topic.publishers))
        if topic.subscribers:
            made.set_subscribed_topic(topic.name, list(topic.subscribers))
    for service, nodes in graph.services.items():
        if is_open(service):
            made.set_advertised_service(service, list(nodes))
    return made
