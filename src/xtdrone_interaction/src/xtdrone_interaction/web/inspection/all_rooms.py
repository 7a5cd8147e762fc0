"""Opens the rooms of inspection, which share one subscription per topic."""

from __future__ import annotations

from xtdrone_interaction.topics.raw_subscriptions import RawSubscriptions
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.images.image_room import ImageRoom
from xtdrone_interaction.web.inspection.console_room import ConsoleRoom
from xtdrone_interaction.web.inspection.node_graph_room import NodeGraphRoom
from xtdrone_interaction.web.inspection.page_subscriptions import PageSubscriptions
from xtdrone_interaction.web.inspection.plot_room import PlotRoom
from xtdrone_interaction.web.inspection.topic_room import TopicRoom
from xtdrone_interaction.web.parameters.parameter_room import ParameterRoom
from xtdrone_interaction.web.server.methods import Method


def inspection_methods(context: StationContext) -> list[Method]:
    """Open all rooms and return their methods."""
    topics = RawSubscriptions()
    pages = PageSubscriptions(context, topics)
    topic_room = TopicRoom(context, topics, pages)
    rooms = (
        topic_room,
        PlotRoom(context, topic_room, pages),
        ConsoleRoom(context, topics),
        ParameterRoom(context),
        NodeGraphRoom(context, topic_room),
        ImageRoom(context, topic_room, pages),
    )
    return [method for room in rooms for method in room.methods()]
