"""ROS node with a server of rosbridge's protocol; see ``nodes/rosbridge_websocket.py``."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import rosgraph
import rospy

from xtdrone_common.programs.node_command_line import check_no_arguments
from xtdrone_common.programs.plain_node import init_plain_node
from xtdrone_common.settings import setting
from xtdrone_interaction.bridges import bridge_settings
from xtdrone_interaction.bridges.bridge_settings import BridgeSettings
from xtdrone_interaction.bridges.rosbridge.clients.session import Bridge
from xtdrone_interaction.bridges.rosbridge.clients.subscriptions import Encoder
from xtdrone_interaction.bridges.rosbridge.rosapi import Rosapi
from xtdrone_interaction.bridges.rosbridge.websocket_server import WebSocketServer
from xtdrone_interaction.ending import end_within_limit
from xtdrone_interaction.server_port import check_not_running, port_here
from xtdrone_interaction.topics.raw_subscriptions import RawSubscriptions

NAME = "rosbridge_websocket"
PORT = 9090
_CALLS = 64  # service calls at a time, of all clients
_LOOK = 0.2  # s between checks for shutdown


@dataclass(frozen=True)
class RosbridgeSettings(BridgeSettings):
    """Private parameters of the node, by the names of rosbridge_server where it has them."""

    port: int = setting(
        PORT,
        low=0,
        high=65535,
        text="TCP port; 0: any free one, which is logged; 9090 is 540 N higher for instance N",
    )
    max_message_size: int = setting(
        10_000_000,
        low=1000,
        high=1_000_000_000,
        unit="bytes",
        text="maximum frame size; a larger frame closes the connection",
    )


class _Parameters:
    """The parameter server, with one connection per call, so that any thread may call it."""

    def __getattr__(self, method: str) -> Callable[..., Any]:
        return lambda *arguments: getattr(rosgraph.Master(rospy.get_name()), method)(*arguments)


def _bridge(settings: RosbridgeSettings) -> Bridge:
    graph = bridge_settings.graph_of(settings)
    services = bridge_settings.services_of(settings)

    def now() -> tuple[int, int]:
        time = rospy.get_rostime()
        return time.secs, time.nsecs

    return Bridge(
        graph=graph,
        raw=RawSubscriptions(),
        encoder=Encoder(),
        publications=bridge_settings.publications_of(graph),
        services=services,
        rosapi=Rosapi(graph.read, services.type_of, _Parameters(), settings.params_glob, now, settings.operate),
        serve=rospy.Service,
        calls=ThreadPoolExecutor(_CALLS, "rosbridge call"),
        call_limit=settings.call_timeout,
        operate=settings.operate,
        now=rospy.get_rostime,
    )


async def _serve(settings: RosbridgeSettings) -> None:
    bridge = _bridge(settings)
    server = WebSocketServer(bridge, settings.max_message_size, bridge_settings.guard_of(settings, NAME))
    port = server.listen(settings.port, settings.address)
    rospy.set_param("~actual_port", port)
    rospy.loginfo(f"{NAME}: ws://{settings.address}:{port}")
    while not rospy.is_shutdown():
        await asyncio.sleep(_LOOK)
    bridge.raw.close()
    await server.close()


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
    settings = RosbridgeSettings.from_parameters(rospy.get_param)
    settings = replace(settings, port=port_here(settings.port, PORT))
    bridge_settings.warn_of_network(settings, NAME)
    try:
        asyncio.run(_serve(settings))
    except OSError as error:
        text = f"{NAME}: port {settings.port} of {settings.address} cannot be opened: {error}"
        raise rospy.ROSInitException(text) from error
