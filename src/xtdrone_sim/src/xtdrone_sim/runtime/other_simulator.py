"""Checks before the simulator registers as a node: whether another simulator is running.

When a node registers under a name in use, the master shuts down the node that holds it. Therefore these functions query
the master without registering.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlparse

import rosgraph
import rospy

_URI = "/lockstep/uri"
_ANSWER_LIMIT = 2.0  # s


def obstacle(name: str) -> str:
    """Return the reason why a simulator called ``name`` cannot run on this master; "" if it can.

    Args:
        name: resolved name of the node.
    """
    master, uri = rosgraph.Master(name), rosgraph.get_master_uri()
    elsewhere = "or use another master for this one (ROS_MASTER_URI)"
    lockstep = _lockstep_uri(master)
    if lockstep and answers(lockstep):
        return (
            f"a simulator is already running on the ROS master {uri}, with its lockstep at {lockstep}; stop it "
            f"(Ctrl-C where it was started, or rosnode kill /simulator), {elsewhere}"
        )
    try:
        node = str(master.lookupNode(name))
    except rosgraph.MasterError:
        return ""
    if answers(node):
        return (
            f"the node name {name} is taken on the ROS master {uri} by a node that is running, at {node}; stop it "
            f"(rosnode kill {name}), {elsewhere}"
        )
    return ""


def ready_words(names: Sequence[str], speed: float) -> str:
    """Return a summary of the simulation, for the log line at its start.

    Args:
        names: names of the vehicles, in order.
        speed: target real-time factor; 0 for unlimited.
    """
    vehicles, verb = (names[0], "is") if len(names) == 1 else (f"{names[0]} to {names[-1]}", "are")
    world = str(rospy.get_param("/xtdrone/world", ""))  # the simplified simulator has none
    parts = [
        *([f"world {Path(world).stem}"] if world else []),
        f"{speed:g} x real time" if speed else "as fast as possible",
        f"ROS master {rosgraph.get_master_uri()}",
    ]
    instance = rospy.get_param("/xtdrone/instance", 0)
    if instance:
        parts.append(f"instance {instance}")
    return f"{vehicles} {verb} ready, time runs: {', '.join(parts)}"


def stale_uri(name: str) -> str:
    """Return the lockstep address that a terminated simulator has left on the master; "" for none."""
    return _lockstep_uri(rosgraph.Master(name))


def _lockstep_uri(master: rosgraph.Master) -> str:
    return str(master.getParam(_URI)) if master.hasParam(_URI) else ""


def answers(uri: str) -> bool:
    """Return whether a server accepts connections at ``uri``, scheme://host:port."""
    try:
        address = urlparse(uri)
        if not address.hostname or not address.port:
            return False
        socket.create_connection((address.hostname, address.port), timeout=_ANSWER_LIMIT).close()
    except (OSError, ValueError):
        return False
    return True
