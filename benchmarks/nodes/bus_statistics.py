"""Number of messages published by nodes, read from their bus statistics (``getBusStats`` of rospy).

Counting needs no subscription, so it does not load the nodes.
"""

from __future__ import annotations

import re
import xmlrpc.client
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rosgraph import Master

Connections = dict[int, int]
"""Messages sent by number of the connection."""
_Key = tuple[str, str]
"""Node and topic."""

ROLES = {
    "commands": r"/xtdrone/\w+_\d+/cmd_(vel|accel)_enu",
    "setpoints": r"/\w+_\d+/mavros/setpoint_raw/local",
    "poses": r"/\w+_\d+/mavros/local_position/pose",
    "swarm": r"/xtdrone/swarm",
}
"""Topics by role. Followers publish commands, and communication nodes setpoints, once per cycle; the MAVROS layer
publishes every received pose, and the swarm's message once per cycle with new poses."""


@dataclass(frozen=True)
class Counts:
    """Messages published so far.

    Attributes:
        sent: messages by connection, for each node and topic.
        times: simulated time of the request to each node, s.
    """

    sent: Mapping[_Key, Connections]
    times: Mapping[str, float]


def publishers(master: Master) -> dict[str, dict[str, str]]:
    """Return the roles by topic, for each node that publishes such topics.

    Raises:
        rosgraph.MasterException, OSError: the master does not answer.
    """
    found: dict[str, dict[str, str]] = {}
    for topic, nodes in master.getSystemState()[0]:
        for role, pattern in ROLES.items():
            if re.fullmatch(pattern, topic):
                for node in nodes:
                    found.setdefault(node, {})[topic] = role
    return found


def take(
    master: Master,
    roles: Mapping[str, Mapping[str, str]],
    now: Callable[[], float],
    proxy: Callable[[str], Any] = xmlrpc.client.ServerProxy,
) -> Counts:
    """Request the statistics of all nodes.

    Args:
        master: resolves their addresses.
        roles: roles by topic, for each node; see :func:`publishers`.
        now: returns the simulated time, s.
        proxy: connects to the address of a node.

    Raises:
        rosgraph.MasterException, OSError: the master or a node does not answer.
    """
    sent: dict[_Key, Connections] = {}
    times = {}
    for node, topics in roles.items():
        answer = proxy(master.lookupNode(node)).getBusStats("/formation_speed_meter")
        times[node] = now()
        for topic, _, connections in answer[2][0]:
            if topic in topics:
                sent[node, topic] = {int(number): int(count) for number, _, count, *_ in connections}
    return Counts(sent, times)


def rates(roles: Mapping[str, Mapping[str, str]], before: Counts, after: Counts) -> dict[str, float]:
    """Return the messages published per simulated second by role, as the mean over nodes and topics.

    Of several connections of a topic, the one with the most messages counts; connections made in between do not.
    """
    found: dict[str, list[float]] = {}
    for node, topics in roles.items():
        elapsed = after.times[node] - before.times[node]
        for topic, role in topics.items():
            first, last = before.sent.get((node, topic), {}), after.sent.get((node, topic), {})
            counts = [last[number] - count for number, count in first.items() if number in last]
            if counts and elapsed > 0.0:
                found.setdefault(role, []).append(max(counts) / elapsed)
    return {role: sum(values) / len(values) for role, values in found.items()}
