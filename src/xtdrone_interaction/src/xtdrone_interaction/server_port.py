"""What the servers of web pages share: node names, ports per simulation, and a limit of unused connections."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlparse

import rosgraph
import rospy
from tornado.httpserver import HTTPServer

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import FleetError, check_instance, instance_port
from xtdrone_sim.runtime.other_simulator import answers

_INSTANCE = "/xtdrone/instance"
MOST_CONNECTIONS = 256
"""Connections of a server that are no WebSockets; beyond them the oldest is closed."""
_REQUEST_LIMIT = 10.0  # s of wall time for a request's headers, and between two requests
_MOST_HEADERS = 1 << 14  # bytes
_MOST_BODY = 1 << 16  # bytes


class BoundedHTTPServer(HTTPServer):
    """An HTTP server that stays available while idle or slow connections are open."""

    def initialize(self, *given: Any, **named: Any) -> None:
        """Set the limits."""
        named |= {"idle_connection_timeout": _REQUEST_LIMIT, "max_header_size": _MOST_HEADERS}
        named |= {"max_body_size": _MOST_BODY}
        super().initialize(*given, **named)
        self._in_order: dict[Any, None] = {}

    def handle_stream(self, stream: Any, address: Any) -> None:
        """Serve a connection; too old ones yield."""
        super().handle_stream(stream, address)
        self._in_order.update(dict.fromkeys(self._connections - self._in_order.keys()))
        for oldest in list(self._in_order)[: len(self._in_order) - MOST_CONNECTIONS]:
            del self._in_order[oldest]
            oldest.stream.close()

    def on_close(self, server_conn: Any) -> None:
        """Forget a connection that has closed, or has become a WebSocket."""
        super().on_close(server_conn)
        self._in_order.pop(server_conn, None)


def check_not_running(name: str, address: str = "") -> None:
    """Check that no other server of this node's name runs: the master would shut it down when this one registers.

    Args:
        name: as passed to ``rospy.init_node``.
        address: name of the server's private parameter with its URL or port, if it has one.

    Raises:
        ROSInitException: it runs; the message gives its URL.
    """
    node = lockstep.future_name(name)
    master = rosgraph.Master(node)
    try:
        uri = str(master.lookupNode(node))
        if not answers(uri):
            return
        parameter = f"{node}/{address}" if address else ""
        there = master.getParam(parameter) if parameter and master.hasParam(parameter) else ""
    except (OSError, rosgraph.MasterError):  # without a master, rospy.init_node waits for it
        return
    if isinstance(there, int):
        there = f"ws://{urlparse(uri).hostname}:{there}"
    where = f", at {there}" if there else ""
    raise rospy.ROSInitException(f"{name}: it runs already{where}; use that one, or end it first (rosnode kill {node})")


def instance_here() -> int:
    """Return the number of this ROS master's simulation on its machine, 0 without one."""
    try:
        return check_instance(rospy.get_param(_INSTANCE, 0))
    except FleetError:
        return 0


def port_here(port: int, usual: int) -> int:
    """Return the port to listen on: the default port shifts with the instance, like the MAVLink ports.

    Args:
        port: that of the settings.
        usual: the default of the settings; any other port was chosen by the user and is kept.
    """
    return instance_port(port, instance_here()) if port == usual else port
