"""Metrics of each vehicle in a recording, and all metrics of recordings and flight logs for their reports."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import asdict
from typing import Any

import numpy as np

from xtdrone_interaction.metrics import odometry_errors
from xtdrone_interaction.metrics.setpoint_tracking import trackings
from xtdrone_interaction.recording.distances import least_distances
from xtdrone_interaction.recording.flight_from_ulog import FlightLog
from xtdrone_interaction.recording.found_mission import FoundMission
from xtdrone_interaction.recording.recorded_flight import RecordError, Recording, VehicleRecord
from xtdrone_interaction.recording.series_in_bounded_memory import Series, spans

_INFO = ("sys_name", "release", "ver_hw", "ver_sw_release", "ver_sw", "sys_uuid")
_LOG = ("way", "highest", "greatest_speed", "least_voltage", "modes")


def summarise(recording: Recording, found: FoundMission | None) -> dict[str, Any]:
    """Return the metrics of a recording as plain data.

    Args:
        recording: of any kind but a flight log.
        found: Its formation flight, if it has one.
    """
    figures: dict[str, Any] = {
        "file": str(recording.path),
        "bytes": recording.size,
        "messages": sum(topic.count for topic in recording.topics),
        "duration": recording.duration,
        "start": recording.origin or None,
        "cut_off": recording.cut,
        "notes": recording.notes,
        "vehicles": {vehicle.name: vehicle_metrics(vehicle) for vehicle in recording.vehicles},
        "odometry": odometry_errors.of_recording(recording),
        "collisions": recording.collisions,
        "formation": None,
    }
    if found is not None:
        try:
            figures["formation"] = found.metrics()
        except RecordError as error:
            figures["notes"] = [*recording.notes, str(error)]
    return figures


def summarise_log(recording: Recording, log: FlightLog) -> dict[str, Any]:
    """Return the metrics of a flight log as plain data.

    Args:
        recording: of the log.
        log: the log itself.
    """
    vehicle = vehicle_metrics(recording.vehicles[0], log.duration)
    return {
        "file": str(log.path),
        "bytes": log.size,
        "duration": log.duration,
        "cut_off": log.cut,
        "notes": log.notes,
        "vehicle": {key: log.info[key] for key in _INFO if key in log.info},
        "armed_time": vehicle["armed_time"] or 0.0,
        **{key: vehicle[key] for key in _LOG},
        "tracking": [{"what": what, **asdict(found)} for what, found in trackings(log)],
    }


def vehicle_metrics(vehicle: VehicleRecord, end: float | None = None) -> dict[str, Any]:
    """Return the metrics of one vehicle; unknown ones are None.

    Args:
        vehicle: the recorded vehicle.
        end: of the recording, s; None for the end of the vehicle's own series.

    Returns:
        armed_time (s), way (m), highest and lowest (m, above the first position), greatest_speed (horizontal) and
        greatest_climb (m/s), least_voltage (V), modes (s in each), warnings (number of texts of severity warning or
        worse).
    """
    position, velocity, battery = vehicle.position, vehicle.series.get("velocity"), vehicle.series.get("battery")
    found: dict[str, Any] = dict.fromkeys(
        ("armed_time", "way", "highest", "lowest", "greatest_speed", "greatest_climb", "least_voltage")
    )
    if end is None:
        end = max((float(series.time[-1]) for series in vehicle.series.values() if len(series)), default=0.0)
    if vehicle.armed:
        found["armed_time"] = sum(stop - start for start, stop, armed in spans(vehicle.armed, end) if armed)
    if position is not None and len(position):
        found["way"] = way_length(position)
        height = position.value[:, 2] - position.value[0, 2]
        found |= {"highest": _finite(np.nanmax(height)), "lowest": _finite(np.nanmin(height))}
    if velocity is not None and len(velocity):
        found["greatest_speed"] = _finite(np.nanmax(np.hypot(velocity.value[:, 0], velocity.value[:, 1])))
        found["greatest_climb"] = _finite(np.nanmax(velocity.value[:, 2]))
    if battery is not None and np.isfinite(battery.value[:, 0]).any():
        found["least_voltage"] = _finite(np.nanmin(battery.value[:, 0]))
    lasted: dict[str, float] = {}
    for start, stop, mode in spans(vehicle.modes, end):
        lasted[mode] = lasted.get(mode, 0.0) + stop - start
    return found | {"modes": lasted, "warnings": sum(bad <= 4 for _, bad, _ in vehicle.texts)}


def least_distance_series(positions: Collection[Series]) -> Series | None:
    """Return the minimum distance between any two vehicles over time, m, (t, 1), while all positions are known.

    Args:
        positions: of at least one vehicle, m, each (t, 3) and not empty.

    Returns:
        None if they are never all known.
    """
    first, last = max(series.time[0] for series in positions), min(series.time[-1] for series in positions)
    grid = max(positions, key=len).time
    grid = grid[(grid >= first) & (grid <= last)]
    if not len(grid):
        return None
    rows = np.stack([series.at(grid) for series in positions], axis=1)
    return Series(grid, least_distances(rows)[:, None])


def way_length(place: Series, grain: float = 0.1) -> float:
    """Return the length of the path of a vehicle, m, without noise.

    Args:
        place: position, m, shape (t, 3).
        grain: m; a position counts once it is this far from the last one that counted.
    """
    good = place.value[np.isfinite(place.value).all(axis=1)]
    if not len(good):
        return 0.0
    total, last = 0.0, good[0]
    at = 0
    while True:
        # search for the next position far enough away, in ever larger parts
        size = 64
        while True:
            away = np.linalg.norm(good[at : at + size] - last, axis=1)
            far = np.flatnonzero(away >= grain)
            if far.size or at + size >= len(good):
                break
            size *= 8
        if not far.size:
            return total
        at += int(far[0])
        total += float(away[far[0]])
        last = good[at]


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
