"""Topics of a ROS graph with their types, publishers and subscribers, read from the master over XML-RPC."""

from __future__ import annotations

import xmlrpc.client
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from xtdrone_interaction.simulation_services import NO_XMLRPC, TimedTransport

_CALLER = "/xtdrone_topics"
UNKNOWN_TYPE = "*"


class MasterError(RuntimeError):
    """A ROS master that does not answer, or not as one."""


@dataclass(frozen=True)
class Topic:
    """One topic.

    Attributes:
        name: resolved.
        type: such as ``geometry_msgs/Twist``; ``*`` as long as no node has named it.
        publishers: nodes, in order.
        subscribers: nodes, in order.
    """

    name: str
    type: str
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()


@dataclass(frozen=True)
class TopicGraph:
    """What a master knows.

    Attributes:
        topics: by name, in order.
        services: nodes that offer each service, by name.
    """

    topics: Mapping[str, Topic]
    services: Mapping[str, tuple[str, ...]]

    @property
    def nodes(self) -> list[str]:
        """Names of the nodes that publish, subscribe or offer a service, in order."""
        groups = [names for topic in self.topics.values() for names in (topic.publishers, topic.subscribers)]
        return sorted({node for names in (*groups, *self.services.values()) for node in names})


def read_topics(uri: str) -> TopicGraph:
    """Return the topics and services of a master.

    Args:
        uri: of the master.

    Raises:
        MasterError: there is no ROS master.
    """
    try:
        publishers, subscribers, services = _call(uri, "getSystemState")
        types = dict(_call(uri, "getTopicTypes"))
        return join_topics(publishers, subscribers, services, types)
    except (OSError, ValueError, TypeError, *NO_XMLRPC) as error:
        raise MasterError(f"master: the ROS master at {uri} does not answer: {error}") from error


def join_topics(
    publishers: Sequence[tuple[str, Sequence[str]]],
    subscribers: Sequence[tuple[str, Sequence[str]]],
    services: Sequence[tuple[str, Sequence[str]]],
    types: Mapping[str, str],
) -> TopicGraph:
    """Return the graph of a master's answers: nodes by topic, by service, and types by topic."""
    sent = {name: tuple(sorted(nodes)) for name, nodes in publishers}
    heard = {name: tuple(sorted(nodes)) for name, nodes in subscribers}
    topics = {
        name: Topic(name, types.get(name, UNKNOWN_TYPE), sent.get(name, ()), heard.get(name, ()))
        for name in sorted({*sent, *heard})
    }
    return TopicGraph(topics, {name: tuple(sorted(nodes)) for name, nodes in sorted(services)})


def _call(uri: str, method: str) -> Any:
    proxy: Any = xmlrpc.client.ServerProxy(uri, transport=TimedTransport())
    code, text, value = getattr(proxy, method)(_CALLER)
    if code != 1:
        raise ValueError(f"{method}: {text}")
    return value
