"""Metrics of a flight through obstacles: clearance to the world's true shapes, time against a straight flight."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from xtdrone_interaction.formation.distances import least_distances
from xtdrone_interaction.metrics.clearance import Solid, least_distances_to
from xtdrone_interaction.metrics.missions.formation_crossing_metrics import formation_figures
from xtdrone_interaction.metrics.missions.formation_metrics import versions
from xtdrone_interaction.recording.missions.crossing_record import CrossingRecord


def make_report(
    record: CrossingRecord, solids: Sequence[Solid], settings: Mapping[str, Any], timings: Mapping[str, Any]
) -> dict[str, Any]:
    """Return all metrics of a flight as plain data.

    Args:
        record: the flight.
        solids: obstacles of the world.
        settings: of the flight, stored as they are; ``speed_limit``, m/s, gives the time of a straight flight.
        timings: of map updates and plans by vehicle, stored as they are.
    """
    report = {
        "vehicles": {name: _vehicle(record, n, solids, settings) for n, name in enumerate(record.names)},
        "least_distance": float(least_distances(record.position).min()) if len(record.names) > 1 else None,
        "formation": formation_figures(record),
        "collisions": record.collisions,
        "simulated_time": float(record.time[-1]),
        "timings": dict(timings),
        "settings": dict(settings),
        "versions": versions(),
    }
    report["shortcomings"] = _shortcomings(report)
    return report


def _vehicle(
    record: CrossingRecord, index: int, solids: Sequence[Solid], settings: Mapping[str, Any]
) -> dict[str, Any]:
    crossing = record.crossing_of(record.names[index])
    flown = record.position[:, index]
    values: dict[str, Any] = {"outcome": crossing["outcome"], "goal": crossing["goal"]}
    values["clearance"] = float(least_distances_to(solids, flown).min()) if solids else None
    if crossing["begun"] is None or crossing["ended"] is None:
        return values
    part = flown[(record.time >= crossing["begun"]) & (record.time <= crossing["ended"])]
    length = float(np.linalg.norm(np.diff(part, axis=0), axis=1).sum())
    straight = float(np.linalg.norm(part[-1] - part[0]))
    time = crossing["ended"] - crossing["begun"]
    values |= {
        "time": time,
        "path": length,
        "straight": straight,
        "mean_speed": straight / time,
        "straight_time": straight_time(straight, float(settings["speed_limit"]), float(settings["acceleration_limit"])),
    }
    return values


def straight_time(length: float, speed: float, acceleration: float) -> float:
    """Return the time, s, of a flight from rest to rest along a line, m, without obstacles, within limits."""
    if speed * speed / acceleration >= length:
        return 2.0 * math.sqrt(length / acceleration)
    return length / speed + speed / acceleration


def _shortcomings(report: Mapping[str, Any]) -> list[str]:
    found = [f"{name}: {v['outcome']}" for name, v in report["vehicles"].items() if v["outcome"] != "arrived"]
    return found + list(report["collisions"])
