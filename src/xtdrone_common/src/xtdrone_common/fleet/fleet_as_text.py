"""Fleets as text: ``iris:9``, and the list of a fleet file, which gives names, models and start poses."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from xtdrone_common.files import ContentError, load_yaml, read_text

from .start_places import start_pose
from .vehicle import MAX_VEHICLES, OFFBOARD_PORTS, XTDRONE, FleetError, StartPose, Vehicle, check_instance, check_ports

_KEYS = ("name", "type", "model", "pose", "id")
_TYPE = r"[a-z][a-z0-9_]*"
_MOST_TEXT = 256 * 1024  # bytes; a thousand for each vehicle
_MOST_INDEX = 9999
_MOST_NAME = 64  # characters of a type or name


def parse_fleet(text: str, instance: int = 0, ports: str = XTDRONE) -> tuple[Vehicle, ...]:
    """Return the vehicles that ``text`` describes, in order of their ids.

    Args:
        text: comma-separated ``type:count``, as ``"iris:9"``, where ``type`` alone means one; or the YAML list of a
            fleet file, see :func:`read_fleet_file`.
        instance: number of the simulation on this machine, which offsets the ports.
        ports: those of the offboard links, a key of ``OFFBOARD_PORTS``.

    Raises:
        FleetError: a malformed entry, a total not in 1..250 or too large for ``ports``, a type or name given twice, or
            an invalid instance or ``ports``.
    """
    check_instance(instance)
    check_ports(ports)
    return with_ports(_parse(text, instance), ports)


def with_ports(fleet: Sequence[Vehicle], ports: str) -> tuple[Vehicle, ...]:
    """Return the fleet with offboard links on ``ports``, a key of ``OFFBOARD_PORTS``.

    Raises:
        FleetError: there are too many vehicles for these ports, or an id is too high for them.
    """
    most = OFFBOARD_PORTS[ports].vehicles
    if len(fleet) > most:
        raise FleetError(f"vehicles: {len(fleet)} with ports {ports!r} are not allowed, 1 to {most}")
    for vehicle in fleet:
        if vehicle.id >= most:
            raise FleetError(f"id: {vehicle.id} of {vehicle.name} with ports {ports!r} is not allowed, 0 to {most - 1}")
    return tuple(replace(vehicle, ports=ports) for vehicle in fleet)


def _parse(text: str, instance: int) -> tuple[Vehicle, ...]:
    if not _is_list(text):
        return _parse_counts(text, instance)
    try:
        return _parse_list(text, instance)
    except FleetError as error:
        raise FleetError(f"vehicles: {error}") from error


def read_fleet_file(path: str | Path, instance: int = 0) -> tuple[Vehicle, ...]:
    """Return the vehicles of a fleet file.

    The file is a YAML list with one entry for each vehicle: ``name``, such as ``iris_0``, or ``type``, which names the
    vehicles in order; ``model`` (default: the type); ``pose`` (x, y, z, roll, pitch, yaw; default: its place on the
    spawn grid); ``id`` (default: the lowest free one), which gives the MAVLink system id and the ports.

    Raises:
        FleetError: the file cannot be read, or an entry is not allowed; the message gives file and entry.
    """
    try:
        return _parse_list(read_text(path, _MOST_TEXT), instance)
    except OSError as error:
        raise FleetError(f"fleet file {path}: {error.strerror or error}") from error
    except (ContentError, FleetError) as error:
        raise FleetError(f"fleet file {path}: {error}") from error


def fleet_text(fleet: Sequence[Vehicle]) -> str:
    """Return the shortest text that ``parse_fleet`` reads as this fleet."""
    counts = Counter(vehicle.type for vehicle in fleet)
    short = ",".join(f"{kind}:{count}" for kind, count in counts.items())
    if fleet and parse_fleet(short, fleet[0].instance, fleet[0].ports) == tuple(fleet):
        return short
    return json.dumps([_entry(vehicle) for vehicle in fleet])


def place_ids(fleet: Sequence[Vehicle], reserve: int) -> list[int]:
    """Return the id of each vehicle slot: those of the fleet, then the lowest free ones for ``reserve`` more vehicles.

    Raises:
        FleetError: ``reserve`` is negative, or there would be more slots than the fleet's ports are for.
    """
    ids = [vehicle.id for vehicle in fleet]
    highest = OFFBOARD_PORTS[fleet[0].ports].vehicles if fleet else MAX_VEHICLES
    most = highest - len(fleet)
    if not 0 <= reserve <= most:
        raise FleetError(f"reserve: {reserve} is not allowed, 0 to {most} beside {len(fleet)} vehicles")
    return ids + [number for number in range(highest) if number not in ids][:reserve]


def vehicle_named(name: str, vehicle_id: int, instance: int, model: str = "", pose: StartPose | None = None) -> Vehicle:
    """Return the vehicle with a name such as ``iris_0``.

    Raises:
        FleetError: the name or the model is not allowed.
    """
    kind, index = split_name(name)
    return Vehicle(kind, index, vehicle_id, instance, _model(model) if model else "", pose)


def split_name(name: Any) -> tuple[str, int]:
    """Return the type and the index of a vehicle's name.

    Raises:
        FleetError: not TYPE_INDEX, such as ``iris_0``.
    """
    match = re.fullmatch(rf"({_TYPE})_(0|[1-9]\d{{0,3}})", name) if isinstance(name, str) else None
    if match is None or len(name) > _MOST_NAME:
        raise FleetError(
            f"name: {repr(name)[:80]} is not allowed, a type of small letters, digits and _, then _ and a number from "
            f"0 to {_MOST_INDEX}, such as iris_0"
        )
    return match[1], int(match[2])


def _is_list(text: str) -> bool:
    return "\n" in text.strip() or text.lstrip()[:1] in ("[", "-", "#")


def _parse_counts(text: str, instance: int) -> tuple[Vehicle, ...]:
    vehicles: list[Vehicle] = []
    seen: set[str] = set()
    for entry in text.split(","):
        match = re.fullmatch(rf"\s*({_TYPE})(?:\s*:\s*(-?\d{{1,9}}))?\s*", entry)
        if match is None:
            raise FleetError(f"vehicles: {entry!r} is not of the form type:count, such as iris:9")
        kind, count = match[1], int(match[2] or 1)
        if kind in seen:
            raise FleetError(f"vehicles: type {kind!r} is named twice in {text!r}")
        seen.add(kind)
        if count < 1 or len(vehicles) + count > MAX_VEHICLES:
            raise FleetError(f"vehicles: {count} of type {kind!r}: 1 to {MAX_VEHICLES} vehicles in all are allowed")
        vehicles += [Vehicle(kind, i, len(vehicles) + i, instance) for i in range(count)]
    return tuple(vehicles)


def _parse_list(text: str, instance: int) -> tuple[Vehicle, ...]:
    try:
        entries = load_yaml(text)
    except ContentError as error:
        raise FleetError(f"not valid YAML: {error}") from error
    if not isinstance(entries, list):
        raise FleetError(f"a list of vehicles is needed, not {type(entries).__name__}")
    if not 1 <= len(entries) <= MAX_VEHICLES:
        raise FleetError(f"{len(entries)} vehicles are not allowed, 1 to {MAX_VEHICLES}")
    vehicles: list[Vehicle] = []
    for number, entry in enumerate(entries, 1):
        try:
            vehicles.append(_vehicle(entry, vehicles, instance))
        except FleetError as error:
            raise FleetError(f"entry {number}: {error}") from error
    return tuple(sorted(vehicles, key=lambda vehicle: vehicle.id))


def _vehicle(entry: Any, before: Sequence[Vehicle], instance: int) -> Vehicle:
    if not isinstance(entry, dict):
        raise FleetError(f"{repr(entry)[:80]} is not allowed, a mapping with {', '.join(_KEYS)}")
    for key in entry:
        if key not in _KEYS:
            raise FleetError(f"{repr(key)[:40]} is not known; there are {', '.join(_KEYS)}")
    name = _name(entry, before)
    if any(vehicle.name == name for vehicle in before):
        raise FleetError(f"name: {name!r} is given twice")
    pose = start_pose(entry["pose"]) if "pose" in entry else None
    vehicle = vehicle_named(name, _id(entry, before), instance, _model(entry.get("model", "")), pose)
    if entry.get("type", vehicle.type) != vehicle.type:
        raise FleetError(f"type: {repr(entry['type'])[:80]} is not allowed, {name} is of type {vehicle.type!r}")
    return vehicle


def _name(entry: dict[str, Any], before: Sequence[Vehicle]) -> str:
    """Return the name of an entry: as given, or the next of its type."""
    if "name" in entry:
        split_name(entry["name"])
        return str(entry["name"])
    if "type" not in entry:
        raise FleetError("name and type are missing, one of them is needed")
    kind = entry["type"]
    if not isinstance(kind, str) or re.fullmatch(_TYPE, kind) is None or len(kind) > _MOST_NAME - 5:
        raise FleetError(f"type: {repr(kind)[:80]} is not allowed, small letters, digits and _, as iris")
    index = max((vehicle.index for vehicle in before if vehicle.type == kind), default=-1) + 1
    return f"{kind}_{index}"


def _id(entry: dict[str, Any], before: Sequence[Vehicle]) -> int:
    """Return the id of an entry: as given, or the lowest one that no entry before it has."""
    used = {vehicle.id: vehicle.name for vehicle in before}
    if "id" not in entry:
        return next(number for number in range(MAX_VEHICLES) if number not in used)
    number = entry["id"]
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < MAX_VEHICLES:
        raise FleetError(f"id: {repr(number)[:40]} is not allowed, a whole number from 0 to {MAX_VEHICLES - 1}")
    if number in used:
        raise FleetError(f"id: {number} is not allowed, {used[number]} has it")
    return number


def _model(value: Any) -> str:
    if not isinstance(value, str) or len(value) > 4096 or not value.isprintable():
        raise FleetError(
            f"model: {repr(value)[:80]} is not allowed, the name of a vehicle's description or a YAML file"
        )
    return value


def _entry(vehicle: Vehicle) -> dict[str, Any]:
    entry: dict[str, Any] = {"name": vehicle.name, "id": vehicle.id}
    if vehicle.model != vehicle.type:
        entry["model"] = vehicle.model
    if vehicle.pose is not None:
        entry["pose"] = list(vehicle.pose)
    return entry
