"""Opens a recording of any kind: bag, flight log (ULog), archive of a flight without ROS (.npz), table (.csv)."""

from __future__ import annotations

import csv
import json
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.recording.flight_events import parse_event
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.flight_from_ulog import NAMELESS, FlightLog, LogError, is_log, read_log
from xtdrone_interaction.recording.recorded_flight import Change, RecordError, Recording, VehicleRecord
from xtdrone_interaction.recording.series_in_bounded_memory import Series

COLUMNS = ("time", "x", "y", "z")
"""Columns of a table, in s and m ENU; and ``vehicle`` if there are several."""


def open_recording(files: Sequence[Path], part: int | None = None) -> Recording:
    """Read a recording.

    Args:
        files: one file, or the consecutive bags of a split recording.
        part: number of the flight in a bag whose simulated time was reset, from 1; None for the longest.

    Raises:
        BagError, LogError, RecordError: nothing can be read of it.
    """
    first = files[0]
    logs = [file for file in files if file.suffix == ".ulg" or is_log(file)]
    if logs and len(files) > 1:
        raise LogError(f"analyse: {str(logs[0])!r} is a flight log, of which one is analysed at a time; see compare")
    if logs:
        return log_recording(read_log(first))
    if first.suffix == ".npz":
        return read_archive(first)
    if first.suffix == ".csv":
        return read_table(first)
    recording = read_bag(files, part=part)
    if not recording.topics:
        raise BagError("; ".join([f"bag: {str(first)!r} has no messages that can be read", *recording.notes]))
    return recording


def read_table(path: Path) -> Recording:
    """Read positions from a table with COLUMNS.

    Raises:
        RecordError: it cannot be read, or lacks a column.
    """
    rows: dict[str, list[list[float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if missing := [column for column in COLUMNS if column not in (reader.fieldnames or ())]:
                raise RecordError(f"table: {str(path)!r} has no column {missing[0]!r}; needed: {', '.join(COLUMNS)}")
            for row in reader:
                values = [float(row[column]) for column in COLUMNS]
                if all(map(math.isfinite, values)):
                    rows.setdefault(row.get("vehicle") or NAMELESS, []).append(values)
    except RecordError:
        raise
    except (OSError, UnicodeDecodeError, csv.Error, TypeError, ValueError) as error:
        raise RecordError(f"table: {str(path)!r} cannot be read as a table: {error}") from error
    recording = Recording(path, path.stat().st_size)
    for name, points in rows.items():
        table = np.array(sorted(points))
        recording.vehicles.append(VehicleRecord(name, {"pose": Series(table[:, 0], table[:, 1:])}))
        recording.duration = max(recording.duration, float(table[-1, 0]))
    return recording


def log_recording(log: FlightLog) -> Recording:
    """Return a flight log as a recording of one vehicle, from the first arming to the last disarming, ENU."""
    vehicle = VehicleRecord(str(log.info.get("vehicle_name") or NAMELESS), modes=log.modes, armed=log.armed)
    to_enu = np.array([1.0, 1.0, -1.0])
    position = log.flown_series("vehicle_local_position", "y", "x", "z")
    velocity = log.flown_series("vehicle_local_position", "vy", "vx", "vz")
    voltage = log.series("battery_status", "voltage_v")
    if position is not None:
        vehicle.series["pose"] = Series(position.time, position.value * to_enu)
    if velocity is not None:
        vehicle.series["velocity"] = Series(velocity.time, velocity.value * to_enu)
    if voltage is not None:
        unknown = np.full((len(voltage), 2), np.nan)
        vehicle.series["battery"] = Series(voltage.time, np.hstack([voltage.value, unknown]))
    return Recording(log.path, log.size, log.notes, log.cut, duration=log.duration, vehicles=[vehicle], flight_log=log)


def read_archive(path: Path) -> Recording:
    """Read the archive of a formation flight in one process, ``flight.npz``: see ``missions.formation.record``.

    Raises:
        RecordError: it is something else.
    """
    try:
        with np.load(path, allow_pickle=False) as data:
            times = data["pattern_time"].tolist()
            names, time, position = data["names"].tolist(), data["time"], data["position"]
            return Recording(
                path,
                path.stat().st_size,
                duration=float(time[-1] - time[0]) if len(time) else 0.0,
                vehicles=[VehicleRecord(name) for name in names],
                models={name: Series(time, position[:, i]) for i, name in enumerate(names)},
                truth_source=str(data["source"]),
                patterns=[Change(t, value) for t, value in zip(times, data["offsets"], strict=True)],
                topologies=[Change(t, value) for t, value in zip(times, data["topology"], strict=True)],
                events=[parse_event(json.dumps(event)) for event in json.loads(str(data["events"]))],
                collisions=json.loads(str(data["collisions"])),
            )
    except (OSError, KeyError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise RecordError(f"flight record: {path} cannot be read ({error})") from error
