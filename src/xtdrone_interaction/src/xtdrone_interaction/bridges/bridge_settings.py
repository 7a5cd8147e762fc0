"""Parameters common to all bridges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import rosgraph
import rospy

from xtdrone_common.settings import Settings, setting
from xtdrone_interaction.bridges.bridge_graph import BridgeGraph
from xtdrone_interaction.bridges.ros_publications import Publications
from xtdrone_interaction.bridges.ros_services import Services
from xtdrone_interaction.server_guard import ServerGuard, is_loopback, listed, names_setting, origins_setting
from xtdrone_interaction.topics.discovery import read_topics

_OLDEST = 1.0  # s, age after which the graph is read again, unless reading takes long


@dataclass(frozen=True)
class BridgeSettings(Settings):
    """Private parameters of every bridge."""

    address: str = setting(
        "127.0.0.1", text="listening address; 0.0.0.0 lets every machine of the network watch and command"
    )
    topics_glob: tuple[str, ...] = setting(("*",), parse=listed, allowed="shell patterns", text="topics offered")
    services_glob: tuple[str, ...] = setting(("*",), parse=listed, allowed="shell patterns", text="services offered")
    params_glob: tuple[str, ...] = setting(("*",), parse=listed, allowed="shell patterns", text="parameters offered")
    origins: tuple[str, ...] = origins_setting()
    names: tuple[str, ...] = names_setting()
    operate: bool = setting(True, text="true: clients may publish, call services and set parameters; false: only watch")
    call_timeout: float = setting(30.0, low=0.1, high=3600.0, unit="s", text="timeout of a service's response")


def warn_of_network(settings: BridgeSettings, name: str) -> None:
    """Log that other machines may connect."""
    if not is_loopback(settings.address):
        can = "watch and command" if settings.operate else "watch"
        rospy.logwarn(f"{name}: every machine that can reach {settings.address} may {can} this simulation")


def guard_of(settings: BridgeSettings, name: str) -> ServerGuard:
    """Return the check of the clients' requests; refusals are logged. ``name``: of the node."""
    return ServerGuard(name, settings.address, settings.origins, settings.names, report=rospy.logwarn)


def graph_of(settings: BridgeSettings) -> BridgeGraph:
    """Return the graph of this process's ROS master."""
    return BridgeGraph(rosgraph.get_master_uri(), settings.topics_glob, _OLDEST)


def publications_of(graph: BridgeGraph) -> Publications:
    """Return the publishers of this process."""

    def subscribers(topic: str) -> int:
        found = read_topics(rosgraph.get_master_uri()).topics.get(topic)  # not from the cache, which may be seconds old
        return 0 if found is None else len(found.subscribers)

    return Publications(rospy.Publisher, graph.topic_type, subscribers)


def services_of(settings: BridgeSettings) -> Services:
    """Return the services of this process's ROS master; each call has its own connection to it."""
    return Services(lookup_service(), rospy.get_name(), settings.services_glob)


def lookup_service() -> Callable[[str], str]:
    """Return a function that asks the ROS master for the URI of a service; it may be called by any thread."""
    name = rospy.get_name()

    def lookup(service: str) -> str:
        return str(rosgraph.Master(name).lookupService(service))

    return lookup
