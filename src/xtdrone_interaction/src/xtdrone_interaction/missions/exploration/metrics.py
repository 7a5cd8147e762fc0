"""Metrics of an exploration: the visible part of a floor, and the share of it that was seen, over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_interaction.missions.exploration.record import ExplorationRecord
from xtdrone_interaction.missions.solids import Solid, least_distances_to
from xtdrone_interaction.recording.distances import least_distances
from xtdrone_interaction.report.report_json import versions
from xtdrone_planning.exploration.floor_map import FREE, OCCUPIED, FloorMap
from xtdrone_planning.exploration.frontiers import Ways
from xtdrone_planning.exploration.settings import ExplorationSettings

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_APART = 0.45  # m between two viewpoints
_BEARINGS = 720
_SIGHT = 9.0  # m
ENOUGH = 0.95
"""Share of the visible floor that a complete exploration has seen."""


def visible_cells(
    solids: Sequence[Solid], settings: ExplorationSettings, start: tuple[float, float]
) -> tuple[Mask, Mask]:
    """Return which cells of a floor can be seen, and which are solid.

    A cell can be seen if it is in sight, within 9 m, of a place that a vehicle can reach from ``start`` with the
    clearance of the settings.

    Args:
        solids: of the world.
        settings: of the exploration.
        start: x, y, m in map.

    Returns:
        Two masks (nx, ny) over the cells of a ``FloorMap`` of the settings.
    """
    floor = FloorMap(settings)
    nx, ny = floor.own.shape
    x, y = floor.middles(np.arange(nx), 0), floor.middles(np.arange(ny), 1)
    places = np.stack(np.broadcast_arrays(x[:, None], y, settings.flight_height), axis=-1).reshape(-1, 3)
    high = [solid for solid in solids if least_distances_to([solid], _above(solid, settings.flight_height))[0] < 0.01]
    solid_cells = (least_distances_to(high, places) <= 0.5 * floor.cell).reshape(nx, ny)
    floor.own = np.where(solid_cells, OCCUPIED, FREE).astype(np.int8)
    floor.merge()
    reachable = np.isfinite(Ways(floor, floor.index(np.array(start)), settings.clearance).costs)
    step = max(1, round(_APART / floor.cell))
    lattice = np.zeros_like(reachable)
    lattice[::step, ::step] = True
    seen = np.zeros((nx, ny), np.bool_)
    for i, j in np.argwhere(reachable & lattice):
        seen |= _seen_from(floor, solid_cells, floor.middle((int(i), int(j))))
    return seen & floor.inside, solid_cells


def _above(solid: Solid, height: float) -> Array:
    """Return the place at a height, m, over or under a solid's centre, (1, 3)."""
    x, y, _ = solid.pose.position
    return np.array([[x, y, height]])


def _seen_from(floor: FloorMap, solid: Mask, place: Array) -> Mask:
    """Return the cells in sight of a place, (2,) m, and the solid ones at which the sight ends."""
    bearings = np.linspace(0.0, 2.0 * math.pi, _BEARINGS, endpoint=False)
    steps = np.arange(0.0, _SIGHT, 0.5 * floor.cell)
    shape = np.array(solid.shape)
    i = np.floor((place[0] + np.outer(np.cos(bearings), steps)) / floor.cell).astype(np.int64) - floor.first[0]
    j = np.floor((place[1] + np.outer(np.sin(bearings), steps)) / floor.cell).astype(np.int64) - floor.first[1]
    within = (i >= 0) & (j >= 0) & (i < shape[0]) & (j < shape[1])
    i, j = np.clip(i, 0, shape[0] - 1), np.clip(j, 0, shape[1] - 1)
    met = solid[i, j]
    open_so_far = (np.cumsum(met, axis=1) - met == 0) & within
    seen = np.zeros_like(solid)
    seen[i[open_so_far], j[open_so_far]] = True
    return seen


def make_report(
    record: ExplorationRecord,
    solids: Sequence[Solid],
    visible: Mask,
    settings: Mapping[str, Any],
    timings: Mapping[str, Any],
) -> dict[str, Any]:
    """Return all metrics of an exploration as plain data.

    Args:
        record: the flight.
        solids: obstacles of the world.
        visible: see ``visible_cells``.
        settings: of the flight, stored as they are.
        timings: of map updates and plans by vehicle, stored as they are.
    """
    curve = coverage(record, visible)
    begun = min((c["begun"] for c in map(record.outcome_of, record.names) if c["begun"] is not None), default=0.0)
    reached = next((time for time, share in curve if share >= ENOUGH), None)
    report = {
        "vehicles": {name: _vehicle(record, n, solids) for n, name in enumerate(record.names)},
        "coverage": curve[-1][1] if curve else 0.0,
        "time_to_95_percent": None if reached is None else reached - begun,
        "explored_after": None if record.explored is None else record.explored - begun,
        "coverage_over_time": [[round(time - begun, 3), round(share, 5)] for time, share in curve],
        "least_distance": float(least_distances(record.position).min()) if len(record.names) > 1 else None,
        "collisions": record.collisions,
        "simulated_time": float(record.time[-1]),
        "timings": dict(timings),
        "settings": dict(settings),
        "versions": versions(),
    }
    report["shortcomings"] = _shortcomings(report)
    return report


def coverage(record: ExplorationRecord, visible: Mask) -> list[tuple[float, float]]:
    """Return times, s, and the share of the visible cells that some vehicle has seen by then."""
    known = np.zeros_like(visible)
    curve = []
    for time, cells in record.floors:
        if cells.shape == known.shape:
            known |= cells >= 0
            curve.append((time, float(known[visible].mean())))
    return curve


def _vehicle(record: ExplorationRecord, index: int, solids: Sequence[Solid]) -> dict[str, Any]:
    crossing, flown = record.outcome_of(record.names[index]), record.position[:, index]
    return {
        "outcome": crossing["outcome"],
        "path": float(np.linalg.norm(np.diff(flown, axis=0), axis=1).sum()),
        "clearance": float(least_distances_to(solids, flown[flown[:, 2] > 1.0]).min(initial=np.inf)),
    }


def _shortcomings(report: Mapping[str, Any]) -> list[str]:
    found = [f"{name}: {v['outcome']}" for name, v in report["vehicles"].items() if v["outcome"] != "arrived"]
    if report["coverage"] < ENOUGH:
        found.append(f"seen {100 * report['coverage']:.1f} % of the visible floor, at least {100 * ENOUGH:.0f} %")
    return found + list(report["collisions"])
