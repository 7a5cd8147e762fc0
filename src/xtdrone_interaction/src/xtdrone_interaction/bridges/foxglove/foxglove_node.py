"""ROS node with a server of Foxglove's WebSocket protocol; see ``nodes/foxglove_bridge.py``."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import foxglove
import rosgraph
import rospy
from foxglove import Parameter, StatusLevel
from foxglove.websocket import Capability, ChannelView, Client, ClientChannel, ServerListener

from xtdrone_common.programs.node_command_line import check_no_arguments
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_common.settings import setting
from xtdrone_interaction.bridges import bridge_settings
from xtdrone_interaction.bridges.bridge_settings import BridgeSettings
from xtdrone_interaction.bridges.foxglove.client_topics import ENCODINGS, ClientTopics
from xtdrone_interaction.bridges.foxglove.connection_graph import to_connection_graph
from xtdrone_interaction.bridges.foxglove.guarded_port import GuardedPort, hidden_address
from xtdrone_interaction.bridges.foxglove.parameter_values import ParameterError, RosParameters
from xtdrone_interaction.bridges.foxglove.service_offers import ServiceOffers
from xtdrone_interaction.bridges.foxglove.standing_client import StandingClient
from xtdrone_interaction.bridges.foxglove.topic_channels import TopicChannels
from xtdrone_interaction.ending import end_within_limit
from xtdrone_interaction.server_port import check_not_running, port_here
from xtdrone_interaction.topics.discovery import UNKNOWN_TYPE, MasterError, TopicGraph
from xtdrone_interaction.topics.raw_subscriptions import RawSubscriptions

NAME = "foxglove_bridge"
PORT = 8765
_CLOCK_PERIOD = 0.05  # s of wall time between two time updates to clients
_GRAPH_PERIOD = 1.0  # s between two reads of the graph
_PARAMETER_PERIOD = 2.0  # s between two reads of the parameters that clients watch


@dataclass(frozen=True)
class FoxgloveSettings(BridgeSettings):
    """Private parameters of the node."""

    port: int = setting(
        PORT,
        low=0,
        high=65535,
        text="TCP port; 0: any free one, which is logged; 8765 is 540 N higher for instance N",
    )
    send_buffer_limit: int = setting(
        1024,
        low=16,
        high=100_000,
        unit="messages",
        text="messages queued for a slow client; beyond this, the oldest are dropped",
    )


class Listener(ServerListener):
    """Dispatches the clients' requests. Called in the SDK's threads; calls that wait for the master have their own
    threads."""

    def __init__(self, topics: TopicChannels, published: ClientTopics, parameters: RosParameters, report: Any) -> None:
        self._topics = topics
        self._published = published
        self._parameters = parameters
        self._report = report
        self._worker = ThreadPoolExecutor(1, "foxglove clients")  # keeps the order of a client's messages
        self.watched: set[str] = set()
        self.standing: StandingClient | None = None  # as soon as the server has a port

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Subscribe to the channel's topic."""
        self._topics.on_subscribe(channel.topic)

    def on_unsubscribe(self, client: Client, channel: ChannelView) -> None:
        """End the subscription, unless other clients have one."""
        self._topics.on_unsubscribe(channel.topic)

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        """Advertise a client's topic."""
        arguments = (client.id, channel.id, channel.topic, channel.encoding, channel.schema_name)
        self._worker.submit(self._published.advertise, *arguments)

    def on_client_unadvertise(self, client: Client, client_channel_id: int) -> None:
        """End a client's topic."""
        self._worker.submit(self._published.unadvertise, client.id, client_channel_id)

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        """Publish a client's message."""
        self._worker.submit(self._published.publish, client.id, client_channel_id, data)

    def on_get_parameters(
        self, client: Client, param_names: list[str], request_id: str | None = None
    ) -> list[Parameter]:
        """Return parameters; all without names."""
        return self._told("parameters", lambda: self._parameters.get(param_names))

    def on_set_parameters(
        self, client: Client, parameters: list[Parameter], request_id: str | None = None
    ) -> list[Parameter]:
        """Set parameters and return their values after it; of the bridge's own client, return what it tells."""
        told = self.standing.told(request_id) if self.standing else None
        if told is not None:
            return told
        names = [parameter.name for parameter in parameters]
        self._told("set parameters", lambda: self._parameters.set(parameters))
        return self._told("parameters", lambda: self._parameters.get(names)) if names else []

    def on_parameters_subscribe(self, param_names: list[str]) -> None:
        """Begin to watch parameters."""
        self.watched |= set(param_names)

    def on_parameters_unsubscribe(self, param_names: list[str]) -> None:
        """End watching parameters."""
        self.watched -= set(param_names)

    def _told(self, what: str, function: Callable[[], list[Parameter]]) -> list[Parameter]:
        """Return the result of a function; report its failure to clients."""
        try:
            return function()
        except ParameterError as error:
            self._report(what, str(error))
        except Exception as error:  # rosgraph.MasterError, or any error of a broken XML-RPC exchange
            self._report(what, f"{what}: the ROS master does not answer: {error}")
        return []


class FoxgloveBridge:
    """The server, with its channels, services and parameters."""

    def __init__(self, settings: FoxgloveSettings) -> None:
        """Open the port.

        Raises:
            OSError, RuntimeError: it cannot be opened.
        """
        self._port = GuardedPort(
            bridge_settings.guard_of(settings, NAME), settings.address, settings.port, rospy.logwarn
        )
        self.port = self._port.port
        context = foxglove.Context()
        self._graph = bridge_settings.graph_of(settings)
        self.raw = RawSubscriptions()
        self._topics = TopicChannels(context, self.raw, self._warn)
        published = ClientTopics(bridge_settings.publications_of(self._graph), self._graph.is_open, self._warn)
        self._parameters = RosParameters(
            lambda: rosgraph.Master(rospy.get_name()), settings.params_glob, settings.operate
        )
        self._listener = Listener(self._topics, published, self._parameters, self._warn)
        capabilities = [Capability.Time, Capability.Parameters, Capability.ConnectionGraph]
        if settings.operate:
            capabilities += [Capability.Services, Capability.ClientPublish]
        self._server = foxglove.start_server(
            name="XTDrone",
            host=(address := hidden_address()),
            port=0,
            capabilities=capabilities,
            supported_encodings=list(ENCODINGS),
            server_listener=self._listener,
            context=context,
            message_backlog_size=settings.send_buffer_limit,
        )
        self._standing = self._listener.standing = StandingClient(address, self._server.port)
        self._port.serve(address, self._server.port)
        services = bridge_settings.services_of(settings)
        self._is_offered = services.is_offered
        self._services = None
        if settings.operate:
            self._services = ServiceOffers(services, self._server, settings.call_timeout, self._warn)
        self._told_graph: TopicGraph | None = None
        self._new_graph: TopicGraph | None = None  # not told yet
        self._told: dict[str, Any] = {}
        self._time = -1

    def _warn(self, id_: str, text: str) -> None:
        """Report a rejection to clients and the log; a new text replaces the old one of the same identifier."""
        rospy.logwarn(f"{NAME}: {text}")
        self._server.publish_status(text, StatusLevel.Warning, id_)

    def tell_time(self) -> None:
        """Send clients the simulated time, if it has changed; after a reset they restart."""
        now = rospy.get_rostime().to_nsec()
        if now == self._time:
            return
        if now < self._time:
            self._server.clear_session()
        self._time = now
        self._server.broadcast_time(now)

    def update(self) -> None:
        """Update the offered topics, services and nodes from the graph."""
        try:
            graph = self._graph.read()
        except MasterError as error:
            self._warn("master", str(error))
            return
        topics = graph.topics.values()
        self._topics.update({t.name: t.type for t in topics if t.type != UNKNOWN_TYPE and t.publishers})
        if self._services is not None:
            self._services.update(graph.services)
        self._new_graph = graph if graph != self._told_graph else None

    def tell_graph(self) -> None:
        """Send clients the nodes of the topics and services if they have changed, as soon as the server is ready."""
        if self._new_graph is None or not self._standing.answers():
            return
        self._told_graph, self._new_graph = self._new_graph, None
        self._server.publish_connection_graph(to_connection_graph(self._told_graph, self._is_offered))

    def tell_parameters(self) -> None:
        """Send clients the watched parameters that have changed."""
        if not self._listener.watched or not self._standing.stands:
            return
        try:
            found = self._parameters.get(sorted(self._listener.watched))
        except Exception as error:  # rosgraph.MasterError, or any error of a broken XML-RPC exchange
            self._warn("parameters", f"parameters: the ROS master does not answer: {error}")
            return
        changed = [p for p in found if self._told.get(p.name) != p.get_value()]
        self._told |= {p.name: p.get_value() for p in changed}
        if changed:
            self._standing.tell_parameters(changed)

    def close(self) -> None:
        """Close the port and end the subscriptions."""
        self.raw.close()
        self._port.close()
        self._standing.close()
        self._server.stop()


def _run(bridge: FoxgloveBridge) -> None:
    """Send clients time, topics, services and parameters until shutdown."""
    duties = (
        (_CLOCK_PERIOD, bridge.tell_time),
        (_GRAPH_PERIOD, bridge.update),
        (_CLOCK_PERIOD, bridge.tell_graph),
        (_PARAMETER_PERIOD, bridge.tell_parameters),
    )
    due = [0.0 for _ in duties]
    while not rospy.is_shutdown():
        now = time.monotonic()
        for i, (period, duty) in enumerate(duties):
            if now >= due[i]:
                due[i] = now + period
                duty()
        time.sleep(_CLOCK_PERIOD)


def main(arguments: Sequence[str]) -> None:
    """Run the node until shutdown.

    Raises:
        ArgumentError: invalid arguments.
        SettingError: a parameter is not allowed.
        ROSInitException: a bridge runs already, or the port cannot be opened.
    """
    check_no_arguments(arguments)
    check_not_running(NAME, "actual_port")
    init_plain_node(NAME)
    end_within_limit(NAME)
    settings = FoxgloveSettings.from_parameters(rospy.get_param)
    settings = replace(settings, port=port_here(settings.port, PORT))
    bridge_settings.warn_of_network(settings, NAME)
    try:
        bridge = FoxgloveBridge(settings)
    except (RuntimeError, OSError) as error:
        text = f"{NAME}: port {settings.port} of {settings.address} cannot be opened: {error}"
        raise rospy.ROSInitException(text) from error
    rospy.set_param("~actual_port", bridge.port)
    rospy.loginfo(f"{NAME}: ws://{settings.address}:{bridge.port}")
    try:
        _run(bridge)
    finally:
        bridge.close()
