"""What every ROS node of the project needs of rospy, and the start of nodes outside the lockstep.

The import keeps rospy from losing publishers that the master has named, see ``_keep_every_publisher``.
"""

from __future__ import annotations

import contextlib
import inspect
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

import rospy
import rospy.impl.tcpros_base
from rosgraph.roslogging import RosStreamHandler
from rospy.impl.registration import RegManager

from xtdrone_common.programs.node_command_line import fleet_of

FLEET_PARAMETER = "/xtdrone/fleet"
_POLL_PERIOD = 0.2  # s of wall time: the parameter server sends no notification to a node that is not initialised
_CONNECTION_QUEUE = 1024  # connections waiting to be accepted; the kernel caps the number at net.core.somaxconn


def lengthen_connection_queue() -> None:
    """Lengthen the queue of nodes that connect to this node's topics and services.

    rospy queues five connections. When thirty vehicles call a service in the same tick, Linux drops those in excess,
    and TCP tries again only after 1 s.
    """
    rospy.impl.tcpros_base.start_tcpros_server()
    rospy.impl.tcpros_base._tcpros_server.tcp_ros_server.server_sock.listen(_CONNECTION_QUEUE)


def survive_full_disk() -> None:
    """Drop log lines that cannot be written to standard output; call it after ``rospy.init_node``."""
    for name in ("", "rosout"):
        for handler in logging.getLogger(name or None).handlers:
            if isinstance(handler, RosStreamHandler):
                handler.emit = _guard(handler.emit)  # type: ignore[method-assign]


def _guard(emit: Callable[[logging.LogRecord], None]) -> Callable[[logging.LogRecord], None]:
    def guarded(record: logging.LogRecord) -> None:
        with contextlib.suppress(OSError):
            emit(record)

    return guarded


def init_plain_node(name: str, **options: Any) -> None:
    """Initialise a node outside the lockstep, in place of ``rospy.init_node``.

    Args:
        name: Node name.
        options: Passed to ``rospy.init_node``.
    """
    rospy.init_node(name, **options)
    lengthen_connection_queue()


def wait_for_fleet(vehicle: str = "") -> str:
    """Wait until ``/xtdrone/fleet`` is set, and lists a vehicle.

    Args:
        vehicle: its name, such as ``iris_9``; empty: any fleet will do.

    Returns:
        The parameter.

    Raises:
        ArgumentError: the parameter is malformed.
        ROSInterruptException: the node was shut down while waiting.
    """
    while not _lists(fleet := str(rospy.get_param(FLEET_PARAMETER, "")), vehicle):
        if rospy.is_shutdown():
            raise rospy.ROSInterruptException("shutdown")
        time.sleep(_POLL_PERIOD)
    return fleet


def _lists(fleet: str, vehicle: str) -> bool:
    there = fleet_of(fleet or None) or ()
    return any(vehicle in ("", one.name) for one in there)


# ---- registration with the master ----


def _check_registration() -> None:
    """Check that rospy keeps the publishers to connect to as ``_keep_every_publisher`` expects.

    Raises:
        ImportError: It does not.
    """
    given = list(inspect.signature(RegManager.publisher_update).parameters)
    keeps = {"updates", "cond"} <= set(RegManager.__init__.__code__.co_names)
    takes = {"updates", "cond", "pop", "_connect_topic_thread"} <= set(RegManager.run.__code__.co_names)
    if given != ["self", "resolved_name", "uris"] or not (keeps and takes):
        raise ImportError(f"{inspect.getfile(RegManager)}: this version of rospy registers topics in an unknown way")


def _keep_every_publisher(manager: RegManager, resolved_name: str, uris: Sequence[str]) -> None:
    """Queue a topic's publishers for connection, in place of ``RegManager.publisher_update``.

    rospy's queue takes the last list as the newest and discards the others of the topic. The master's answer to a
    registration is appended when it arrives, after the lists that the master has sent later on another connection, and
    a list for an earlier subscription may arrive after the answer to a later one. Connections to the publishers that
    only the discarded list names would never be made. Here a topic has one entry, with the publishers of all lists: one
    that has ended in the meantime refuses the connection, which costs nothing.
    """
    with manager.cond:
        waiting = [uri for name, older in manager.updates if name == resolved_name for uri in older]
        merged = list(dict.fromkeys([*uris, *waiting]))
        manager.updates = [(name, older) for name, older in manager.updates if name != resolved_name]
        manager.updates.append((resolved_name, merged))
        manager.cond.notify_all()


_check_registration()
RegManager.publisher_update = _keep_every_publisher
