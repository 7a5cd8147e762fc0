"""The formation flight in a recording, for the report and the pictures of formation flights."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

from xtdrone_interaction.analysis.columns import Series
from xtdrone_interaction.analysis.flight import Flight
from xtdrone_interaction.geometry import ESTIMATE, TRUTH
from xtdrone_interaction.record import FlightRecord, Track, read_events, starts_of

END = "end of the recording"
"""The event at the end of a recording whose flight has none."""
_LAST = ("done", "failed")
_LEAST_WINDOW = 0.2  # s; a pattern that was commanded later before the end is left out


def formation_record(flight: Flight) -> FlightRecord | None:
    """Return the formation flight that a recording holds; None if it is none.

    The director's events come from ``events.jsonl`` beside the recording where that is, else from the recording;
    without any, each assigned pattern lasts until the next, and the first vehicle is the leader.
    """
    events = _events(flight)
    starts = starts_of(events)
    if starts:
        names = tuple(str(name) for name in starts[-1]["vehicles"])
    else:
        names = tuple(vehicle.name for vehicle in flight.vehicles)
    if len(names) < 2:
        return None
    truth, estimate = _truth(flight, names), _estimate(flight, names)
    track = truth or estimate
    if track is None:
        return None
    fitting = [change for change in flight.patterns if len(change.value) == len(names) - 1]
    if not starts:
        if not fitting:
            return None
        events = _made_up(fitting, names, track)
    elif events[-1]["event"] not in _LAST or events[-1]["time"] > track.time[-1] + 1.0:
        end = float(track.time[-1])
        events = [event for event in events if event["time"] < end - _LEAST_WINDOW]
        events.append({"event": END, "time": end})
    if not any(event.get("phase") == "takeoff" for event in events):
        events.insert(0, {"event": "phase", "phase": "takeoff", "time": events[0]["time"]})
    return FlightRecord(names, truth, estimate, flight.patterns, flight.topologies, events, flight.collisions)


def _events(flight: Flight) -> list[dict[str, Any]]:
    """Return the director's events, by the flight's times."""
    events = flight.events
    if flight.parts == 1:  # else those beside it may be another part's
        with contextlib.suppress(OSError, ValueError):
            events = read_events(flight.path.with_name("events.jsonl")) or events
    events = [e for e in events if isinstance(e.get("time"), int | float) and isinstance(e.get("event"), str)]
    # wall times would be those of the whole flight, which may not have been recorded
    return [
        {key: value for key, value in event.items() if key != "wall"} | {"time": event["time"] - flight.origin}
        for event in events
    ]


def _made_up(patterns: list[Any], names: tuple[str, ...], track: Track) -> list[dict[str, Any]]:
    start, end = float(track.time[0]), float(track.time[-1])
    events: list[dict[str, Any]] = [
        {"event": "start", "time": start, "vehicles": list(names)},
        {"event": "phase", "phase": "takeoff", "time": start},
    ]
    for number, change in enumerate(patterns, 1):
        if start <= change.time < end:
            pattern = f"pattern {number}"
            events.append({"event": "phase", "phase": pattern, "pattern": pattern, "time": change.time})
            events.append({"event": "assigned", "pattern": pattern, "time": change.time, "offsets": change.value})
    return [*events, {"event": END, "time": end}]


def _truth(flight: Flight, names: tuple[str, ...]) -> Track | None:
    if not all(name in flight.models for name in names):
        return None
    return _track(TRUTH, [flight.models[name] for name in names])


def _estimate(flight: Flight, names: tuple[str, ...]) -> Track | None:
    known = {vehicle.name: vehicle.position for vehicle in flight.vehicles}
    places = [known.get(name) for name in names]
    return _track(ESTIMATE, [place for place in places if place is not None]) if all(places) else None


def _track(source: str, places: list[Series]) -> Track | None:
    """Return places at the times of the first vehicle's."""
    grid = places[0].time
    if not len(grid):
        return None
    rows = np.empty((len(grid), len(places), 3))
    for i, place in enumerate(places):
        for axis in range(3):
            rows[:, i, axis] = np.interp(grid, place.time, place.value[:, axis])
    return Track(source, grid, rows)
