"""Metrics of a flight through obstacles: clearance to the world's true shapes, time against a straight flight.

Of a formation also: how far from their slots the followers were, and when.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from xtdrone_interaction.missions.fleet_record import FleetRecord
from xtdrone_interaction.missions.solids import Solid, least_distances_to
from xtdrone_interaction.recording.distances import Array, formation_error, least_distances
from xtdrone_interaction.report.report_json import versions

_STEADY = 2.0  # s before the path begins and before landing, over which the formed errors are averaged


def make_report(
    record: FleetRecord, solids: Sequence[Solid], settings: Mapping[str, Any], timings: Mapping[str, Any]
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
        "formation": measure_formation(record),
        "collisions": record.collisions,
        "simulated_time": float(record.time[-1]),
        "timings": dict(timings),
        "settings": dict(settings),
        "versions": versions(),
    }
    report["shortcomings"] = _shortcomings(report)
    return report


def _vehicle(record: FleetRecord, index: int, solids: Sequence[Solid], settings: Mapping[str, Any]) -> dict[str, Any]:
    crossing = record.outcome_of(record.names[index])
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


def measure_formation(record: FleetRecord) -> dict[str, Any] | None:
    """Return the errors before, during and after the flight through the obstacles, by the true positions.

    Returns:
        None for a flight without a formation; else ``pattern``, ``offsets`` (m, as assigned), ``formed_after`` and
        ``formed_again_after`` (s, None if it was not), and ``before``, ``during`` and ``after``: ``mean`` and ``most``
        of the followers' distances from their slots (m), None where that part was not flown.
    """
    assigned = [event for event in record.events if event["event"] == "assigned"]
    if not assigned:
        return None
    offsets = np.array(assigned[-1]["offsets"], float)
    begun = {event["phase"]: float(event["time"]) for event in record.events if event["event"] == "phase"}
    start, arrival, end = (begun.get(stage, np.nan) for stage in ("crossing", "forming again", "landing"))
    formed_again = any(event.get("outcome") == "arrived" for event in record.events)
    return {
        "pattern": assigned[-1]["pattern"],
        "offsets": offsets.tolist(),
        "formed_after": _finite(start - float(assigned[-1]["time"])),
        "formed_again_after": _finite(end - arrival) if formed_again else None,
        "before": _errors(record, offsets, start - _STEADY, start),
        "during": _errors(record, offsets, start, arrival),
        "after": _errors(record, offsets, end - _STEADY, end) if formed_again else None,
    }


def _errors(record: FleetRecord, offsets: Array, first: float, last: float) -> dict[str, float] | None:
    """Return mean and maximum error between two times, s; None if one of them is not known or nothing was recorded."""
    part = record.position[(record.time >= first) & (record.time <= last)]
    if not len(part):
        return None
    error = formation_error(part, offsets)
    return {"mean": float(error.mean()), "most": float(error.max())}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
