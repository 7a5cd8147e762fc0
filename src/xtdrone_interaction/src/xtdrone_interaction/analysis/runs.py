"""Runs to compare, whatever they were recorded in: bags, flight logs, archives of flights without ROS, tables.

Places are ENU, metres. Times count from a common beginning, s.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from xtdrone_interaction.analysis.columns import Series
from xtdrone_interaction.analysis.flight import read_flight
from xtdrone_interaction.analysis.formation import formation_record
from xtdrone_interaction.analysis.summary import summarise
from xtdrone_interaction.analysis.ulog import FlightLog, is_log, read_log
from xtdrone_interaction.record import RecordError, read_record
from xtdrone_interaction.report import measure

ALIGNMENTS = ("motion", "armed", "start", "none")
_MOVED = 0.3  # m from its first place: a vehicle that moves
_NAMELESS = "vehicle"
_COLUMNS = ("time", "x", "y", "z")


class CompareError(ValueError):
    """Runs that cannot be compared."""


@dataclass(frozen=True)
class Run:
    """Where vehicles were.

    Attributes:
        name: for legends.
        places: by vehicle, m ENU, each (t, 3).
        armed: when the first vehicle was armed, s; None if that is not known.
        log: the flight log, if it is one.
        patterns: figures of the formation's reconfigurations, as in the report.
        notes: what could not be read.
    """

    name: str
    places: dict[str, Series]
    armed: float | None = None
    log: FlightLog | None = None
    patterns: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def start(self) -> float:
        """The first time at which a place is known."""
        return min(float(series.time[0]) for series in self.places.values())

    @property
    def motion(self) -> float:
        """When the first vehicle began to move; the start if none did."""
        times = []
        for series in self.places.values():
            away = np.linalg.norm(series.value - series.value[0], axis=1)
            times += series.time[away > _MOVED][:1].tolist()
        return min(times, default=self.start)

    def from_time(self, zero: float) -> Run:
        """Return the same with times counted from ``zero``."""
        return replace(self, places={name: series.moved(zero) for name, series in self.places.items()}, armed=None)

    def from_places(self) -> Run:
        """Return the same with each vehicle's places counted from where it was at time 0."""
        moved = {}
        for name, series in self.places.items():
            first = series.at(np.array([max(0.0, float(series.time[0]))]))
            moved[name] = Series(series.time, series.value - first)
        return replace(self, places=moved)


def read_run(path: Path, name: str) -> Run:
    """Read a run.

    Args:
        path: of a bag, a ULog, an archive (.npz) or a table (.csv: time, x, y, z, and vehicle if there are several).
        name: for legends.

    Raises:
        CompareError: nothing can be read, or it has no places.
        BagError, LogError: as of the readers.
    """
    if not path.exists():
        raise CompareError(f"compare: {str(path)!r} does not exist")
    if path.suffix == ".npz":
        run = _archive(path, name)
    elif path.suffix == ".csv":
        run = _table(path, name)
    elif path.suffix == ".ulg" or is_log(path):
        run = _flight_log(path, name)
    else:
        run = _bag(path, name)
    places = {vehicle: series for vehicle, series in run.places.items() if len(series) > 1}
    if not places:
        raise CompareError(f"compare: {str(path)!r} has no positions of any vehicle")
    return replace(run, places=places)


def _bag(path: Path, name: str) -> Run:
    flight = read_flight(path)
    record = formation_record(flight)
    figures = summarise(flight, record)
    armed = [time for vehicle in flight.vehicles for time, is_armed in vehicle.armed if is_armed]
    return Run(
        name,
        {v.name: place for v in flight.vehicles if (place := v.position) is not None},
        min(armed, default=None),
        patterns=figures["formation"]["reconfigurations"] if figures["formation"] else [],
        notes=flight.notes,
    )


def _flight_log(path: Path, name: str) -> Run:
    log = read_log(path)
    place = log.series("vehicle_local_position", "y", "x", "z")
    if place is None:
        return Run(name, {})
    start = log.flown[0]  # before, the estimator may not know where it is
    part = (place.time >= start) & np.isfinite(place.value).all(axis=1)
    series = Series(place.time[part], place.value[part] * [1.0, 1.0, -1.0])
    vehicle = str(log.info.get("vehicle_name") or _NAMELESS)
    return Run(name, {vehicle: series}, start if log.armed else None, log, notes=log.notes)


def _archive(path: Path, name: str) -> Run:
    try:
        record = read_record(path)
        track = record.track
        patterns = [vars(figures) for figures in measure(record, track)]
    except RecordError as error:
        raise CompareError(str(error)) from error
    places = {vehicle: Series(track.time, track.position[:, i]) for i, vehicle in enumerate(record.names)}
    return Run(name, places, patterns=patterns)


def _table(path: Path, name: str) -> Run:
    rows: dict[str, list[list[float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if missing := [column for column in _COLUMNS if column not in (reader.fieldnames or ())]:
                raise CompareError(
                    f"compare: {str(path)!r} has no column {missing[0]!r}; needed: {', '.join(_COLUMNS)}"
                )
            for row in reader:
                values = [float(row[column]) for column in _COLUMNS]
                if all(map(math.isfinite, values)):
                    rows.setdefault(row.get("vehicle") or _NAMELESS, []).append(values)
    except (OSError, UnicodeDecodeError, csv.Error, TypeError, ValueError) as error:
        if isinstance(error, CompareError):
            raise
        raise CompareError(f"compare: {str(path)!r} cannot be read as a table: {error}") from error
    places = {}
    for vehicle, points in rows.items():
        table = np.array(sorted(points))
        places[vehicle] = Series(table[:, 0], table[:, 1:])
    return Run(name, places)


def aligned(runs: Sequence[Run], alignment: str) -> tuple[list[Run], str]:
    """Return the runs with times from a common beginning, and what that is.

    Args:
        runs: any number.
        alignment: of ALIGNMENTS.

    Raises:
        CompareError: a run does not know when it was armed.
    """
    unknown = [run.name for run in runs if run.armed is None]
    if alignment == "armed" and unknown:
        raise CompareError(f"compare: run {unknown[0]!r} does not say when it was armed; choose another --align")
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


def matched(runs: Sequence[Run], vehicle: str | None) -> list[Run]:
    """Return the runs with the vehicles alone that all of them have.

    Args:
        runs: any number.
        vehicle: to compare alone; a run that has a single vehicle is taken to have it, whatever its name.

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
        notes = run.notes if found in (vehicle, _NAMELESS) else [*run.notes, f"its {found} is taken for {vehicle}"]
        chosen.append(replace(run, places={vehicle: run.places[found]}, notes=notes))
    return chosen
