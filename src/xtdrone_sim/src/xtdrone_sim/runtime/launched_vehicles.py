"""Vehicles and MAVROS nodes of launch files in XTDrone's format; time waits for these nodes."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xtdrone_common.fleet import SPAWNED, XTDRONE, FleetError, Vehicle, spawned_fleet, unused_ports, with_ports
from xtdrone_common.fleet.fcu_url import AutopilotLinkError, FcuUrl, parse_fcu_url
from xtdrone_worlds.data_files import package_folder
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.worlds.catalogue import UPSTREAM, is_generated

LAUNCHED_MAVROS = "/xtdrone/launched_mavros"
"""Parameter with a key for each MAVROS node that was launched; the node has the same key as ``KEY``."""
KEY = "launch_key"

_WORLDS = package_folder("xtdrone_sim") / "stand_ins" / "mavlink_sitl_gazebo" / "worlds"
_WORLDS_VARIABLE = "GAZEBO_RESOURCE_PATH"  # environment: folders, separated by colons
_WORLD_ENDINGS = (".world", ".sdf")


@dataclass(frozen=True)
class Launched:
    """Vehicles and MAVROS nodes of a launch.

    Attributes:
        fleet: the vehicles, in order of their ids.
        mavros: names of the MAVROS nodes, sorted.
        warnings: sentences about values that do not have the effect that a user may expect.
    """

    fleet: tuple[Vehicle, ...]
    mavros: tuple[str, ...]
    warnings: tuple[str, ...]


def read_launched(parameters: Mapping[str, Any], instance: int = 0, ports: str = XTDRONE) -> Launched:
    """Return the vehicles and MAVROS nodes that the parameters of a launch describe.

    Args:
        parameters: the whole tree of the parameter server.
        instance: number of the simulation on this machine.
        ports: ports of the offboard links, a key of ``fleet.OFFBOARD_PORTS``.

    Raises:
        FleetError: the vehicles are not allowed, or two MAVROS nodes have the same local port.
    """
    groups = _subtree(parameters, SPAWNED)
    fleet = with_ports(spawned_fleet(groups, instance), ports)
    nodes = dict(_launched_nodes(parameters, set(_subtree(parameters, LAUNCHED_MAVROS)), ""))
    urls = {name: url for name, settings in sorted(nodes.items()) if (url := _url(settings)) is not None}
    _check_local_ports(urls)
    warnings = [*unused_ports(groups, fleet), *_links(fleet, nodes, urls)]
    return Launched(fleet, tuple(sorted(nodes)), tuple(warnings))


def launched_world(name: str) -> str:
    """Return the file or name of the world that a launch gives as Gazebo's ``world_name``.

    Args:
        name: a file; a path below a folder of GAZEBO_RESOURCE_PATH, as worlds/empty.world; or a name of docs/worlds.md.

    Raises:
        ModelError: a file that does not exist.
    """
    path = Path(name)
    if path.suffix not in _WORLD_ENDINGS or path.is_file():
        return name
    folders = [Path(part) for part in os.environ.get(_WORLDS_VARIABLE, "").split(":") if part]
    places = [place for folder in folders for place in (folder / path, folder / "worlds" / path.name)]
    for place in (*places, _WORLDS / path.name):
        if place.is_file():
            return str(place)
    if is_generated(path.stem):
        return path.stem
    known = ", ".join(sorted({*UPSTREAM, *(file.stem for file in _WORLDS.glob("*.world"))}))
    raise ModelError(
        f"world: {name} does not exist; there are {known}; for XTDrone's own, set {_WORLDS_VARIABLE} to its folder "
        "sitl_config, or give the launch file world:=FILE"
    )


def _subtree(parameters: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    tree: Any = parameters
    for part in name.strip("/").split("/"):
        tree = tree.get(part, {}) if isinstance(tree, Mapping) else {}
    return tree if isinstance(tree, Mapping) else {}


def _launched_nodes(tree: Mapping[str, Any], keys: set[str], name: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield name and private parameters of each node whose ``KEY`` is one of ``keys``."""
    if tree.get(KEY) in keys:
        yield name, tree
        return
    for part, below in tree.items():
        if isinstance(below, Mapping):
            yield from _launched_nodes(below, keys, f"{name}/{part}")


def _url(settings: Mapping[str, Any]) -> FcuUrl | None:
    """Return the link of a MAVROS node; None for one that the node itself rejects, with a message."""
    try:
        return parse_fcu_url(str(settings.get("fcu_url", "")))
    except AutopilotLinkError:
        return None


def _check_local_ports(urls: Mapping[str, FcuUrl]) -> None:
    seen: dict[int, str] = {}
    for name, url in urls.items():
        if url.bind_port in seen:
            raise FleetError(
                f"fcu_url: {seen[url.bind_port]} and {name} both have the local port {url.bind_port}; "
                "each needs its own"
            )
        seen[url.bind_port] = name


def _links(
    fleet: tuple[Vehicle, ...], nodes: Mapping[str, Mapping[str, Any]], urls: Mapping[str, FcuUrl]
) -> Iterator[str]:
    """Yield a sentence for each MAVROS node that reaches no vehicle, or whose target is a different one."""
    vehicles = {vehicle.offboard_local_port: vehicle for vehicle in fleet}
    for name, url in urls.items():
        vehicle, target = vehicles.get(url.remote_port), nodes[name].get("target_system_id", 1)
        if vehicle is None:
            ports = ", ".join(str(port) for port in vehicles)
            yield f"{name}: no vehicle has the port {url.remote_port} of its fcu_url; theirs are {ports}"
        elif vehicle.system_id != target:
            yield (
                f"{name}: tgt_system {target} is not that of {vehicle.name} at its fcu_url, "
                f"{vehicle.system_id}; it will not connect"
            )
