"""Start poses: those given by users, and upstream's spawn grid for vehicles without one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from xtdrone_common.files import ContentError, load_yaml

from .vehicle import FleetError, StartPose, Vehicle

MOST_DISTANCE = 100_000.0
"""Limit of x, y and z of a start pose, m."""
MOST_ANGLE = 2.0 * math.pi
"""Limit of the angles of a start pose, rad."""

_LIMITS = {
    "x": (MOST_DISTANCE, "m"),
    "y": (MOST_DISTANCE, "m"),
    "z": (MOST_DISTANCE, "m"),
    "roll": (MOST_ANGLE, "rad"),
    "pitch": (MOST_ANGLE, "rad"),
    "yaw": (MOST_ANGLE, "rad"),
}
_FORM = "x, y and optionally z, roll, pitch, yaw (m and rad, ENU)"


def start_pose(value: Any) -> StartPose:
    """Return the pose given as [x, y, z, roll, pitch, yaw] or as a mapping with these names; all after y are optional.

    Raises:
        FleetError: the value has another form, or a number is not finite or out of range.
    """
    names = list(StartPose._fields)
    if isinstance(value, dict):
        given = {str(key): number for key, number in value.items()}
        for name in given:
            if name not in names:
                raise FleetError(f"pose: {name[:40]!r} is not known; there are {', '.join(names)}")
        for name in ("x", "y"):
            if name not in given:
                raise FleetError(f"pose: {name} is missing; it has {_FORM}")
    elif isinstance(value, list | tuple) and 2 <= len(value) <= len(names):
        given = dict(zip(names, value, strict=False))
    else:
        count = f"a list of {len(value)}" if isinstance(value, list | tuple) else repr(value)[:40]
        raise FleetError(f"pose: {count} is not allowed, a list or mapping of {_FORM}")
    return StartPose(**{name: _coordinate(name, number) for name, number in given.items()})


def _coordinate(name: str, value: Any) -> float:
    limit, unit = _LIMITS[name]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not -limit <= value <= limit:  # an int may be too large for a float
        raise FleetError(f"pose: {name}: {repr(value)[:40]} is not allowed, {-limit:.6g} to {limit:.6g} {unit}")
    return float(value)


def with_poses(fleet: Sequence[Vehicle], text: str) -> tuple[Vehicle, ...]:
    """Return the fleet with the poses of a YAML list, one for each vehicle in order of their ids; "" changes nothing.

    Raises:
        FleetError: not a list of this length, or a pose is not allowed.
    """
    if not text.strip():
        return tuple(fleet)
    try:
        values = load_yaml(text)
    except ContentError as error:
        raise FleetError(f"poses: {text[:60]!r} is not allowed, a list in YAML: {error}") from error
    if not isinstance(values, list):
        raise FleetError(f"poses: {text[:60]!r} is not allowed, a list with a pose for each vehicle")
    if len(values) != len(fleet):
        raise FleetError(f"poses: {len(values)} are given for {len(fleet)} vehicles, one each is needed")
    return tuple(replace(v, pose=_parse_places(v.name, value)) for v, value in zip(fleet, values, strict=True))


def _parse_places(name: str, value: Any) -> StartPose:
    try:
        return start_pose(value)
    except FleetError as error:
        raise FleetError(f"poses: {name}: {error}") from error


def spawn_grid(fleet: Sequence[Vehicle], rows: int) -> list[tuple[float, float, float]]:
    """Return the position of each vehicle on upstream's spawn grid, in metres ENU (x, y, z).

    x = 3 (rows before this type + index mod rows), y = 3 (index div rows + 1), z = 0, where ``rows`` vehicles are
    placed side by side along x and each type starts a new block.

    Raises:
        FleetError: ``rows`` is less than 1.
    """
    if rows < 1:
        raise FleetError(f"rows: {rows} is not allowed, at least 1")
    positions = []
    types = list(dict.fromkeys(v.type for v in fleet))
    for vehicle in fleet:
        before = types.index(vehicle.type) * rows
        x = 3.0 * (before + vehicle.index % rows)
        y = 3.0 * (vehicle.index // rows + 1)
        positions.append((x, y, 0.0))
    return positions


def start_poses(fleet: Sequence[Vehicle], rows: int) -> list[StartPose]:
    """Return the pose at which each vehicle starts: its own, or else its place on the spawn grid, facing east.

    Raises:
        FleetError: ``rows`` is less than 1.
    """
    grid = spawn_grid(fleet, rows)
    return [v.pose or StartPose(*place) for v, place in zip(fleet, grid, strict=True)]
