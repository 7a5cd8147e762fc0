"""The fleet that launch files in XTDrone's format spawn: one group of parameters for each vehicle.

roslaunch sets all parameters before it starts a node. Each inclusion of ``single_vehicle_spawn_xtd.launch`` therefore
only writes its arguments to the parameter server, under a key of its own in ``SPAWNED``, and the simulator reads the
whole fleet from there when it starts: the order of the vehicles does not matter, and none is missed.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import PurePosixPath
from typing import Any

from .fleet_as_text import vehicle_named
from .start_places import start_pose
from .vehicle import MAX_VEHICLES, FleetError, StartPose, Vehicle

SPAWNED = "/xtdrone/spawned"
"""Parameter with the groups, by their keys."""

_POSE = {"x": "x", "y": "y", "z": "z", "roll": "R", "pitch": "P", "yaw": "Y"}  # field of StartPose: launch argument
_PORTS = ("mavlink_udp_port", "mavlink_tcp_port")
_SDF_FILES = (".sdf", ".xacro", ".jinja")


def spawned_fleet(groups: Mapping[str, Any], instance: int = 0) -> tuple[Vehicle, ...]:
    """Return the vehicles of the groups, in order of their ids.

    Args:
        groups: the value of ``SPAWNED``: by arbitrary keys, the arguments of ``single_vehicle_spawn_xtd.launch`` as
            text.
        instance: number of the simulation on this machine, which offsets the ports.

    Raises:
        FleetError: there is no group, a value is not allowed, or two vehicles have the same name, ID or TCP port.
    """
    entries = [dict(group) for group in groups.values() if isinstance(group, Mapping)]
    if not 1 <= len(entries) <= MAX_VEHICLES:
        raise FleetError(
            f"vehicles: {len(entries)} are spawned, 1 to {MAX_VEHICLES} are allowed; a launch file spawns each by "
            "px4's single_vehicle_spawn_xtd.launch"
        )
    vehicles = sorted((_vehicle(entry, instance) for entry in entries), key=lambda vehicle: (vehicle.id, vehicle.name))
    _check_names(vehicles)
    _check_ids(vehicles)
    _check_tcp_ports(entries)
    return tuple(vehicles)


def unused_ports(groups: Mapping[str, Any], fleet: Iterable[Vehicle]) -> list[str]:
    """Return a sentence for each vehicle whose ``mavlink_udp_port`` is not its autopilot's port, which follows its ID.

    Args:
        groups: Groups as for ``spawned_fleet``, which accepts them.
        fleet: the vehicles of the groups.
    """
    wanted = {_name(group): _port(group, "mavlink_udp_port") for group in groups.values()}
    return [
        f"{vehicle.name}: mavlink_udp_port {wanted[vehicle.name]} is not used; ground stations reach it on UDP port "
        f"{vehicle.gcs_local_port}, which follows its ID {vehicle.id}"
        for vehicle in fleet
        if wanted[vehicle.name] != vehicle.gcs_local_port
    ]


def _name(entry: Mapping[str, Any]) -> str:
    return f"{entry.get('vehicle', '')}_{entry.get('ID_in_group', '')}"


def _vehicle(entry: Mapping[str, Any], instance: int) -> Vehicle:
    name = _name(entry)
    try:
        vehicle = vehicle_named(name, _whole(entry, "ID", MAX_VEHICLES - 1), instance, _model(entry), _pose(entry))
        for port in _PORTS:
            _port(entry, port)
    except FleetError as error:
        raise FleetError(f"vehicle {name}: {error}") from error
    return vehicle


def _model(entry: Mapping[str, Any]) -> str:
    """Return the model that the argument ``sdf`` gives by name or by the path of an SDF; empty: the vehicle's type."""
    path = PurePosixPath(str(entry.get("sdf", "")))
    return path.stem if path.suffix in _SDF_FILES else str(path) if str(path) != "." else ""


def _pose(entry: Mapping[str, Any]) -> StartPose:
    return start_pose({field: _number(entry, argument) for field, argument in _POSE.items()})


def _number(entry: Mapping[str, Any], key: str) -> float:
    try:
        return float(entry.get(key, 0.0))
    except (TypeError, ValueError) as error:
        raise FleetError(f"{key}: {str(entry[key])[:40]!r} is not allowed, a number") from error


def _whole(entry: Mapping[str, Any], key: str, highest: int, lowest: int = 0) -> int:
    text = str(entry.get(key, "")).strip()
    if not (text.isascii() and text.isdecimal() and len(text) < 10 and lowest <= int(text) <= highest):
        raise FleetError(f"{key}: {text[:40]!r} is not allowed, a whole number from {lowest} to {highest}")
    return int(text)


def _port(entry: Mapping[str, Any], key: str) -> int:
    return _whole(entry, key, 65535, lowest=1)


def _check_names(vehicles: Iterable[Vehicle]) -> None:
    seen: dict[str, int] = {}
    for vehicle in vehicles:
        if vehicle.name in seen:
            raise FleetError(
                f"vehicle {vehicle.name}: two groups spawn it, with ID {seen[vehicle.name]} and {vehicle.id}; "
                "each needs another pair of vehicle and ID_in_group"
            )
        seen[vehicle.name] = vehicle.id


def _check_ids(vehicles: Iterable[Vehicle]) -> None:
    seen: dict[int, str] = {}
    for vehicle in vehicles:
        if vehicle.id in seen:
            raise FleetError(f"ID: {seen[vehicle.id]} and {vehicle.name} both have {vehicle.id}; each needs its own")
        seen[vehicle.id] = vehicle.name


def _check_tcp_ports(entries: Iterable[Mapping[str, Any]]) -> None:
    seen: dict[int, str] = {}
    for entry in entries:
        port = _port(entry, "mavlink_tcp_port")
        if port in seen:
            raise FleetError(f"mavlink_tcp_port: {seen[port]} and {_name(entry)} both have {port}; each needs its own")
        seen[port] = _name(entry)
