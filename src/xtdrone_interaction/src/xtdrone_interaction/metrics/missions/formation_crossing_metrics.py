"""Figures of a formation that has flown through obstacles: how far from their slots the followers were, and when."""

from __future__ import annotations

from typing import Any

import numpy as np

from xtdrone_interaction.formation.distances import Array, formation_error
from xtdrone_interaction.recording.missions.crossing_record import CrossingRecord

_STEADY = 2.0  # s before the path begins and before landing, over which the formed errors are averaged


def formation_figures(record: CrossingRecord) -> dict[str, Any] | None:
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


def _errors(record: CrossingRecord, offsets: Array, first: float, last: float) -> dict[str, float] | None:
    """Return mean and maximum error between two times, s; None if one of them is not known or nothing was recorded."""
    part = record.position[(record.time >= first) & (record.time <= last)]
    if not len(part):
        return None
    error = formation_error(part, offsets)
    return {"mean": float(error.mean()), "most": float(error.max())}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
