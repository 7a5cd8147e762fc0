"""Metrics of compared runs from any kind of recording: bags, flight logs, archives, tables.

Positions are ENU, metres. Times count from a common beginning, s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from xtdrone_interaction.metrics.spectrum import even_times
from xtdrone_interaction.metrics.vehicle_metrics import least_distance_series, way_length
from xtdrone_interaction.recording.flight_from_ulog import NAMELESS, FlightLog
from xtdrone_interaction.recording.found_mission import Finder, find_none
from xtdrone_interaction.recording.open_recording import open_recording
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series

ALIGNMENTS = ("motion", "armed", "start", "none")
_MOVED = 0.3  # m from its first position: the vehicle moves


class CompareError(ValueError):
    """Runs that cannot be compared."""


@dataclass(frozen=True)
class ComparedRun:
    """A recording that is compared with others.

    Attributes:
        name: of the run.
        places: positions by vehicle, m ENU, each (t, 3).
        armed: when the first vehicle was armed, s; None if unknown.
        log: the flight log, if it is one.
        patterns: metrics of the formation's reconfigurations, as in the report.
        notes: unreadable or doubtful parts, as sentences.
    """

    name: str
    places: dict[str, Series]
    armed: float | None = None
    log: FlightLog | None = None
    patterns: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def start(self) -> float:
        """The first time at which a position is known, s."""
        return min(float(series.time[0]) for series in self.places.values())

    @property
    def motion(self) -> float:
        """When the first vehicle began to move, s; the start if none did."""
        times = []
        for series in self.places.values():
            away = np.linalg.norm(series.value - series.value[0], axis=1)
            times += series.time[away > _MOVED][:1].tolist()
        return min(times, default=self.start)

    def from_time(self, zero: float) -> ComparedRun:
        """Return the run with times counted from ``zero``."""
        return replace(self, places={name: series.since(zero) for name, series in self.places.items()}, armed=None)

    def from_places(self) -> ComparedRun:
        """Return the run with positions relative to each vehicle's position at time 0."""
        moved = {}
        for name, series in self.places.items():
            first = series.at(np.array([max(0.0, float(series.time[0]))]))
            moved[name] = Series(series.time, series.value - first)
        return replace(self, places=moved)


def read_run(path: Path, name: str, find: Finder = find_none) -> ComparedRun:
    """Read a run from a recording of any kind.

    Args:
        path: File of the recording.
        name: Name of the run.
        find: Finds the mission in it.

    Raises:
        CompareError: there is no such file, or it has no positions.
        BagError, LogError, RecordError: nothing can be read of it.
    """
    if not path.exists():
        raise CompareError(f"compare: {str(path)!r} does not exist")
    recording = open_recording([path])
    places = {vehicle: series for vehicle, series in recording.positions.items() if len(series) > 1}
    if not places:
        raise CompareError(f"compare: {str(path)!r} has no positions of any vehicle")
    armed = [time for vehicle in recording.vehicles for time, is_armed in vehicle.armed if is_armed]
    found, patterns, notes = find(recording), [], recording.notes
    try:
        patterns = [] if found is None else found.parts()
    except RecordError as error:
        notes = [*notes, str(error)]
    return ComparedRun(name, places, min(armed, default=None), recording.flight_log, patterns, notes)


def aligned(runs: Sequence[ComparedRun], alignment: str) -> tuple[list[ComparedRun], str]:
    """Return the runs with times from a common beginning, and the label of their time axis.

    Args:
        runs: any number.
        alignment: of ALIGNMENTS.

    Raises:
        CompareError: the arming of a run is unknown.
    """
    unknown = [run.name for run in runs if run.armed is None]
    if alignment == "armed" and unknown:
        raise CompareError(f"compare: the arming time of run {unknown[0]!r} is unknown; choose another --align")
    words = {
        "armed": "time since the first arming [s]",
        "motion": "time since the first motion [s]",
        "start": "time since the first position [s]",
        "none": "time [s]",
    }
    zeros = {
        "armed": [run.armed or 0.0 for run in runs],
        "motion": [run.motion for run in runs],
        "start": [run.start for run in runs],
        "none": [0.0 for _ in runs],
    }[alignment]
    return [run.from_time(zero) for run, zero in zip(runs, zeros, strict=True)], words[alignment]


def matched(runs: Sequence[ComparedRun], vehicle: str | None) -> list[ComparedRun]:
    """Return the runs reduced to their common vehicles.

    Args:
        runs: any number.
        vehicle: the only one to compare; the vehicle of a run with a single one matches whatever its name.

    Raises:
        CompareError: they have none in common.
    """
    if vehicle is None:
        common = [name for name in runs[0].places if all(name in run.places for run in runs)]
        if common:
            return [replace(run, places={name: run.places[name] for name in common}) for run in runs]
        several = [run for run in runs if len(run.places) > 1]
        if several:
            has = "; ".join(f"{run.name} has {', '.join(list(run.places)[:12])}" for run in runs)
            raise CompareError(f"compare: no vehicle is in all runs ({has}); choose one of them with --vehicle")
        vehicle = next(iter(runs[0].places))
    chosen = []
    for run in runs:
        if vehicle not in run.places and len(run.places) > 1:
            raise CompareError(f"compare: run {run.name!r} has no vehicle {vehicle!r}; it has {', '.join(run.places)}")
        found = vehicle if vehicle in run.places else next(iter(run.places))
        notes = run.notes if found in (vehicle, NAMELESS) else [*run.notes, f"its {found} is taken for {vehicle}"]
        chosen.append(replace(run, places={vehicle: run.places[found]}, notes=notes))
    return chosen


@dataclass(frozen=True)
class RunDifference:
    """Distance of a run from the first one, while all positions of both are known.

    Attributes:
        time: shape (t,), s.
        distance: of each vehicle from its position in the first run, m, shape (t, n).
    """

    time: Array
    distance: Array


def difference(first: ComparedRun, other: ComparedRun) -> RunDifference | None:
    """Return the distance of ``other`` from ``first``; None if they have no time in common."""
    both = [(first.places[name], other.places[name]) for name in first.places]
    start = max(float(series.time[0]) for pair in both for series in pair)
    end = min(float(series.time[-1]) for pair in both for series in pair)
    grid = both[0][0].time
    grid = grid[(grid >= start) & (grid <= end)]
    if not len(grid):
        return None
    away = [np.linalg.norm(theirs.at(grid) - ours.at(grid), axis=1) for ours, theirs in both]
    return RunDifference(grid, np.stack(away, axis=1))


def compare(runs: Sequence[ComparedRun]) -> list[dict[str, Any]]:
    """Return metrics of runs as plain data: of each alone, and of its distance from the first.

    Returns:
        For each run: name, duration (s), way (m, of all vehicles), greatest_speed (m/s), least_distance (m), and
        difference_rms, difference_greatest (m), difference_time (s, of the greatest); unknown ones are None.
    """
    rows = []
    for run in runs:
        ends = [float(series.time[-1]) for series in run.places.values()]
        close = least_distance_series(run.places.values()) if len(run.places) > 1 else None
        row: dict[str, Any] = {
            "name": run.name,
            "duration": max(ends) - run.start,
            "way": sum(way_length(series) for series in run.places.values()),
            "greatest_speed": max(float(speed(series).value.max()) for series in run.places.values()),
            "least_distance": None if close is None else float(close.value.min()),
            **dict.fromkeys(("difference_rms", "difference_greatest", "difference_time")),
        }
        found = None if run is runs[0] else difference(runs[0], run)
        if found is not None:
            row |= {
                "difference_rms": float(np.sqrt(np.mean(found.distance**2))),
                "difference_greatest": float(found.distance.max()),
                "difference_time": float(found.time[found.distance.max(axis=1).argmax()]),
            }
        rows.append(row)
    return rows


def speed(series: Series) -> Series:
    """Return the speed of a vehicle, m/s, shape (t, 1), smoothed over a fifth of a second."""
    time, rows = np.unique(series.time, return_index=True)
    if len(time) < 3:
        return Series(time, np.zeros((len(time), 1)))
    grid = even_times(time, max(0.1, float(np.median(np.diff(time)))))
    if len(grid) < 3:
        return Series(time, np.zeros((len(time), 1)))
    places = Series(time, series.value[rows]).at(grid)
    return Series(grid, np.linalg.norm(np.gradient(places, grid, axis=0), axis=1)[:, None])
