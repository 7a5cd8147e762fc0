"""The nodes, topics and parameters of a ROS master, read over XML-RPC with time limits, without joining the graph."""

from __future__ import annotations

import xmlrpc.client
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

from xtdrone_interaction.doctor.findings import Graph
from xtdrone_interaction.simulation_services import NO_XMLRPC, SimError, TimedTransport

CALLER = "/xtdrone_doctor"
_PARALLEL = 16  # nodes asked at a time
_OWN = ("/rosout",)


@dataclass(frozen=True)
class Master:
    """A ROS master.

    Attributes:
        uri: of the master.
        graph: its topics and nodes.
        services: names of the nodes that offer each service.
        parameters: of XTDrone, by name; missing ones are not set.
    """

    uri: str
    graph: Graph
    services: Mapping[str, Sequence[str]] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def parameter(self, name: str, default: Any = "") -> Any:
        """Return a parameter."""
        return self.parameters.get(name, default)


PARAMETERS = (
    "/xtdrone/fleet",
    "/xtdrone/instance",
    "/xtdrone/world",
    "/simulator/autopilot",
    "/simulator/lockstep",
    "/lockstep/uri",
)


def read_master(uri: str, alive: Collection[str] = ()) -> Master:
    """Read the state of a master, and ask each node whether it lives.

    Args:
        uri: of the master.
        alive: nodes that are not asked, as they are known to live.

    Raises:
        SimError: there is no ROS master at ``uri``.
    """
    try:
        publishers, subscribers, services = _call(uri, "getSystemState")
        nodes = {node for group in (publishers, subscribers, services) for _, names in group for node in names}
        silent = _silent(uri, sorted(nodes - set(alive)))
        parameters = {name: value for name in PARAMETERS if (value := _parameter(uri, name)) is not None}
    except (OSError, ValueError, TypeError, *NO_XMLRPC) as error:
        raise SimError(f"master: the ROS master at {uri} does not answer: {error}") from error
    graph = Graph(_living(publishers, silent), _living(subscribers, silent), tuple(silent))
    return Master(uri, graph, _living(services, silent), parameters)


def _living(entries: Iterable[tuple[str, Sequence[str]]], silent: Sequence[str]) -> dict[str, tuple[str, ...]]:
    found = {name: tuple(sorted(set(nodes) - set(silent))) for name, nodes in entries}
    return {name: nodes for name, nodes in found.items() if nodes}


def _call(uri: str, method: str, *arguments: str) -> Any:
    """Return the value of a call to a master or node.

    Raises:
        OSError, ValueError, xmlrpc.client.Error: no valid answer.
    """
    proxy: Any = xmlrpc.client.ServerProxy(uri, transport=TimedTransport())
    code, text, value = getattr(proxy, method)(CALLER, *arguments)
    if code != 1:
        raise ValueError(f"{method}: {text}")
    return value


def _parameter(uri: str, name: str) -> Any:
    try:
        return _call(uri, "getParam", name)
    except ValueError:  # it is not set
        return None


def _silent(uri: str, nodes: Sequence[str]) -> list[str]:
    """Return the registered nodes that do not answer."""
    with ThreadPoolExecutor(_PARALLEL) as pool:
        answers = list(pool.map(lambda node: _lives(uri, node), nodes))
    return [node for node, lives in zip(nodes, answers, strict=True) if not lives and node not in _OWN]


def _lives(uri: str, node: str) -> bool:
    try:
        address = _call(uri, "lookupNode", node)
    except (OSError, ValueError, *NO_XMLRPC):
        return True  # it has unregistered in the meantime
    try:
        _call(address, "getPid")
    except (OSError, ValueError, TypeError, *NO_XMLRPC):
        return False
    return True
