"""Opens the rooms of the tools: inspection as in rqt, parameters, images, layers, recordings, keyboard, gamepad."""

from __future__ import annotations

from pathlib import Path

from xtdrone_interaction import command_options
from xtdrone_interaction.topics.raw_subscriptions import RawSubscriptions
from xtdrone_interaction.web.context import StationContext
from xtdrone_interaction.web.fleet.fleet_watch import FleetWatch
from xtdrone_interaction.web.images.image_room import ImageRoom
from xtdrone_interaction.web.inspection.console_room import ConsoleRoom
from xtdrone_interaction.web.inspection.node_graph_room import NodeGraphRoom
from xtdrone_interaction.web.inspection.page_subscriptions import PageSubscriptions
from xtdrone_interaction.web.inspection.plot_room import PlotRoom
from xtdrone_interaction.web.inspection.topic_room import TopicRoom
from xtdrone_interaction.web.layers.layer_room import LayerRoom
from xtdrone_interaction.web.parameters.parameter_room import ParameterRoom
from xtdrone_interaction.web.recordings.recording_room import RecordingRoom
from xtdrone_interaction.web.server.methods import Method
from xtdrone_interaction.web.station_settings import StationSettings
from xtdrone_interaction.web.steering.steering_room import SteeringRoom

RECORDINGS = "runs"
"""Folder of recordings in the workspace, as ``./xtdrone record`` has it."""


def tool_methods(context: StationContext, settings: StationSettings, fleet: FleetWatch) -> list[Method]:
    """Open the rooms, which share one subscription per topic, and return their methods."""
    topics = RawSubscriptions()
    pages = PageSubscriptions(context, topics)
    topic_room = TopicRoom(context, topics, pages)
    rooms = (
        topic_room,
        PlotRoom(context, topic_room, pages),
        ConsoleRoom(context, topics),
        NodeGraphRoom(context, topic_room),
        ParameterRoom(context),
        ImageRoom(context, topic_room, pages),
        LayerRoom(context, topic_room, pages, fleet),
        RecordingRoom(
            context, Path(settings.recordings) if settings.recordings else command_options.repository() / RECORDINGS
        ),
        SteeringRoom(context),
    )
    return [method for room in rooms for method in room.methods()]
