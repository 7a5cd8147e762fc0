"""The node graph, like rqt_graph: nodes, topics between them, and which nodes take part in the lockstep."""

from __future__ import annotations

from typing import Any

from xtdrone_interaction.simulation_services import SimError, call
from xtdrone_interaction.topics.discovery import TopicGraph
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.inspection.topic_room import TopicRoom
from xtdrone_interaction.web.server.methods import Method, Params
from xtdrone_interaction.web.server.session import Session

_STATUS = "/simulator/get_status"


class NodeGraphRoom:
    """Answers a page's questions on nodes."""

    def __init__(self, context: StationContext, topics: TopicRoom) -> None:
        """Store the context that the rooms share."""
        self._context = context
        self._topics = topics

    def methods(self) -> list[Method]:
        """Return the methods of a page."""
        return [Method("graph.read", self._read)]

    async def _read(self, _session: Session, _params: Params) -> dict[str, Any]:
        graph = await self._topics.graph()
        participants, waiting = await self._context.blocking(self._lockstep, graph)
        return {
            "nodes": [
                {"name": node, "participant": node in participants, "waited": node in waiting} for node in graph.nodes
            ],
            "links": links(graph),
            "services": {name: list(nodes) for name, nodes in graph.services.items()},
        }

    def _lockstep(self, graph: TopicGraph) -> tuple[set[str], set[str]]:
        """Return the nodes of the lockstep, and those that the simulator waits for at this moment."""
        from xtdrone_msgs.srv import GetStatus, GetStatusRequest

        if _STATUS not in graph.services:
            return set(), set()
        try:
            status = call(self._context.master, _STATUS, GetStatus, GetStatusRequest()).status
        except SimError:
            return set(), set()
        return set(status.participants), set(status.waiting_for)


def links(graph: TopicGraph) -> list[dict[str, Any]]:
    """Return the topics that have a publisher and a subscriber, by the pair of nodes: ``{from, to, topics}``."""
    pairs: dict[tuple[str, str], list[str]] = {}
    for topic in graph.topics.values():
        for sender in topic.publishers:
            for receiver in topic.subscribers:
                if sender != receiver:
                    pairs.setdefault((sender, receiver), []).append(topic.name)
    return [{"from": a, "to": b, "topics": names} for (a, b), names in sorted(pairs.items())]
