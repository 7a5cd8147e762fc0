"""Finding the simulator, reserving the node's name, and joining."""

from __future__ import annotations

import signal
import sys
import time

import rosgraph
import rosgraph.names
import rospy

from ..protocol import ProtocolError
from ..transport.rospy_internals import watch_param
from .node_state import Node
from .participant_turns import Client
from .server_link import CONNECT_LIMIT, URI_PARAM, RefusedError

NAME_LIMIT = 3.0
"""Wall seconds for a participant with the node's name to end."""
RETRY_PERIOD = 0.1
"""Wall seconds between attempts to reserve a name."""
LOOK_PERIOD = 0.05
"""Wall seconds between attempts to find the simulator."""
PRIVATE_PARAM = "~lockstep"
"""ROS parameter by which a node opts out of the lockstep."""


def future_name(name: str, argv: list[str] | None = None) -> str:
    """Return the resolved name that ``rospy.init_node`` will give to this node.

    Args:
        name: Name passed to ``rospy.init_node``.
        argv: Command line with remappings; ``sys.argv`` by default.
    """
    mappings = rosgraph.names.load_mappings(sys.argv if argv is None else argv)
    namespace = mappings.get("__ns") or rosgraph.names.get_ros_namespace()
    return rosgraph.names.ns_join(rosgraph.names.make_global_ns(namespace), mappings.get("__name") or name)


def reserve(name: str, node: Node) -> Client | None:
    """Reserve the node's name with a running simulator.

    This must happen before the node registers with the master, which would shut down another node of that name.

    Args:
        name: Resolved name.
        node: The node.

    Returns:
        The client to join with; None if the node does not take part or no simulator responds yet.

    Raises:
        ROSInitException: Another participant has the name, or the simulator uses another protocol version.
    """
    master = rosgraph.Master(name)
    private = rosgraph.names.ns_join(name, PRIVATE_PARAM[1:])
    uri = master.getParam(URI_PARAM) if master.hasParam(URI_PARAM) else ""
    if not uri or (master.hasParam(private) and not master.getParam(private)):
        return None
    began = time.monotonic()
    while True:
        client = Client(uri, node)
        try:
            client.reserve(name)
            return client
        except (OSError, ProtocolError):
            client.close()
            return None  # ``join`` retries, and reports the error if it persists
        except RefusedError as error:
            client.close()
            # The participant that has the name may be about to end.
            if error.code != "taken" or time.monotonic() - began > NAME_LIMIT:
                raise rospy.ROSInitException(f"cannot join the simulator at {uri} ({URI_PARAM}): {error}") from error
        try:
            time.sleep(RETRY_PERIOD)  # the simulator does not announce names that become free
        except KeyboardInterrupt:  # rospy's signal handler is not installed yet
            raise SystemExit(128 + signal.SIGINT) from None


def join(node: Node, reservation: Client | None) -> Client:
    """Find the simulator and join it.

    Waits for a simulator that is starting, and for a participant of the same name that is ending.

    Args:
        node: The node.
        reservation: The client that has reserved the node's name, if any.

    Raises:
        ROSInitException: The simulator does not answer or refuses the node.
        ROSInterruptException: The node is shut down meanwhile.
    """
    if reservation is not None:
        try:
            reservation.join()
            return reservation
        except (OSError, RefusedError, ProtocolError) as error:
            rospy.logdebug(f"the simulator at {reservation.uri} reserved the name but refused the node: {error}")
            reservation.close()
    reported = answered = time.monotonic()
    present_uri = watch_param(URI_PARAM)
    while not rospy.is_shutdown():
        uri = present_uri()
        if not uri:
            if time.monotonic() - reported > CONNECT_LIMIT:
                rospy.loginfo(f"waiting for a simulator ({URI_PARAM} is not set yet)")
                reported = time.monotonic()
            answered = time.monotonic()
        else:
            client = Client(uri, node)
            try:
                client.join()
                return client
            except (OSError, RefusedError, ProtocolError) as error:
                client.close()
                temporary = not isinstance(error, RefusedError) or error.code == "taken"
                if not temporary or time.monotonic() - answered > CONNECT_LIMIT:
                    raise rospy.ROSInitException(
                        f"cannot join the simulator at {uri} ({URI_PARAM}): {error}. If there is no simulator, "
                        f"delete that parameter or set {PRIVATE_PARAM} to false."
                    ) from error
        node.reader.wait_for(LOOK_PERIOD)
    raise rospy.ROSInterruptException("shut down while waiting for the simulator")
