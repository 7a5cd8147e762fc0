"""Reports of a search: events, progress and outcome.

Events are dictionaries with ``event``, ``time`` (s) and, where one vehicle is concerned, ``vehicle``:

=============  =========================================================================================================
started        ``vehicles``; the first vehicle has armed
candidate      ``position``, ``probability``, ``hits``; several images of a vehicle have shown a person
second_look    ``position``; ``takes_over``: whether the look is to take over a following
confirmed      ``position``, ``covariance`` (xx, xy, yx, yy; m^2), ``found_time`` (of the image), ``probability``,
               ``pictures``
rejected       ``position``, ``probability``, ``pictures``, ``hits``
following      ``position``, ``track``
follow_ended   ``reason``, ``duration``
lost_vehicle   ``reason``, ``position``
camera_silent  ``position``
reassigned     ``to``: metres of the path by vehicle; empty if no vehicle can take over
returning      ``reason``
finished       ``outcome`` (found, not found, failed), ``vehicle``, ``position``, ``covariance``, ``found_time``,
               ``covered_area``, ``region_area`` (m^2), ``covered_fraction``, ``possible`` (unconfirmed candidates),
               ``lost``, ``reason``
=============  =========================================================================================================
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .coverage_map import CoverageMap
from .people.candidates import Candidate
from .planning.coverage_path import Point
from .searching_vehicle import State, Vehicle

Event = dict[str, Any]

_PHASES = ("waiting", "taking off", "searching", "second look", "following", "returning", "finished")


@dataclass(frozen=True)
class Find:
    """A confirmed person.

    Attributes:
        vehicle: name of the finder.
        position: m ENU.
        covariance: Covariance of the position: xx, xy, yx, yy, m^2.
        time: Time of the newest image at the confirmation, s.
    """

    vehicle: str
    position: Point
    covariance: tuple[float, float, float, float]
    time: float


def make_event(name: str, time: float, vehicle: Vehicle | None, fields: dict[str, Any]) -> Event:
    """Return an event of the table above."""
    event: Event = {"event": name, "time": round(time, 3)}
    if vehicle is not None:
        event["vehicle"] = vehicle.name
    return {**event, **fields}


def round_xy(position: Sequence[float]) -> list[float]:
    """Return x and y of a position, rounded to mm."""
    return [round(float(position[0]), 3), round(float(position[1]), 3)]


def progress_report(
    vehicles: Mapping[str, Vehicle], coverage: CoverageMap, now: float, *, started: bool, ending: bool, finished: bool
) -> dict[str, Any]:
    """Return the progress of a search: phase, a line of text, state of each vehicle, covered fraction.

    Args:
        vehicles: Vehicles by name.
        coverage: Coverage of the region.
        now: s.
        started: whether a vehicle has armed.
        ending: whether all vehicles have been sent home.
        finished: whether the search is over.
    """
    states = {vehicle.state for vehicle in vehicles.values()}
    phase = "finished" if finished else "returning" if ending else _phase(states, started)
    airborne = sum(vehicle.airborne for vehicle in vehicles.values())
    return {
        "sim_time": round(now, 3),
        "phase": phase,
        "step": _PHASES.index(phase),
        "steps": len(_PHASES) - 1,
        "text": f"covered {100.0 * coverage.fraction:.0f} %, {airborne} of {len(vehicles)} flying",
        "vehicles": {name: vehicle.state.value for name, vehicle in vehicles.items()},
        "covered_fraction": round(coverage.fraction, 4),
    }


def _phase(states: Collection[State], started: bool) -> str:
    for state, phase in ((State.FOLLOWING, "following"), (State.SECOND_LOOK, "second look")):
        if state in states:
            return phase
    if State.SEARCHING in states or State.REJOINING in states:
        return "searching"
    return "taking off" if started else "waiting"


def outcome_report(find: Find | None, failed: bool, coverage: CoverageMap) -> dict[str, Any]:
    """Return the fields of the event ``finished`` that describe the find and the coverage."""
    return {
        "outcome": "found" if find else "failed" if failed else "not found",
        "vehicle": find.vehicle if find else None,
        "position": round_xy(find.position) if find else None,
        "covariance": list(find.covariance) if find else None,
        "found_time": round(find.time, 3) if find else None,
        "covered_area": round(coverage.area, 1),
        "region_area": round(coverage.region_area, 1),
        "covered_fraction": round(coverage.fraction, 4),
    }


def possible_report(candidates: Iterable[Candidate], least_hits: int) -> list[dict[str, Any]]:
    """Return the unconfirmed candidates with at least ``least_hits`` images."""
    return [
        {
            "position": round_xy(candidate.position),
            "probability": round(candidate.probability, 3),
            "hits": candidate.pictures,
            "vehicles": sorted(candidate.hits),
            "status": candidate.status,
        }
        for candidate in candidates
        if not candidate.found and candidate.pictures >= least_hits
    ]
