"""A recorded flight as frames of the fleet at a constant rate, as the page shows a running flight."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_interaction.recording.recorded_flight import Recording, VehicleRecord
from xtdrone_interaction.recording.series_in_bounded_memory import Series

RATE = 10.0  # Hz of the frames
MOST_FRAMES = 36_000  # an hour; longer flights get a lower rate
COLUMNS = 10  # x, y, z (m ENU), quaternion w, x, y, z, velocity vx, vy, vz (m/s), as in the fleet's frame
_MOST_EVENTS = 2000


@dataclass(frozen=True)
class PlayableFlight:
    """A recorded flight.

    Attributes:
        names: of the vehicles.
        start: time of the first frame, s.
        period: between two frames, s.
        frames: shape (t, n, 10), columns as above, NaN for what is unknown.
        events: each {time, vehicle, kind, text}, by time.
    """

    names: tuple[str, ...]
    start: float
    period: float
    frames: NDArray[np.float32]
    events: list[dict[str, Any]]


def playable(recording: Recording) -> PlayableFlight:
    """Return a recording as frames.

    Raises:
        ValueError: it has no vehicle with positions.
    """
    others = recording.positions
    choices = (
        (v.name, (recording.true_poses.get(v.name), v.series.get("pose"), others.get(v.name)))
        for v in recording.vehicles
    )
    found = (
        (name, next((series for series in choice if series is not None and len(series)), None))
        for name, choice in choices
    )
    positions = {name: series for name, series in found if series is not None}
    if not positions:
        raise ValueError(f"recording: {recording.path.name!r} has no positions of vehicles")
    start = min(series.time[0] for series in positions.values())
    end = max(series.time[-1] for series in positions.values())
    period = max(1.0 / RATE, (end - start) / MOST_FRAMES)
    time = start + period * np.arange(math.floor((end - start) / period) + 1)
    frames = np.full((len(time), len(positions), COLUMNS), np.nan, np.float32)
    records = {vehicle.name: vehicle for vehicle in recording.vehicles}
    for i, (name, series) in enumerate(positions.items()):
        frames[:, i, :7] = _poses(series, time)
        frames[:, i, 7:] = _velocities(records[name], series, time)
    return PlayableFlight(tuple(positions), float(start), period, frames, _events(recording))


def _poses(series: Series, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return positions and quaternions w, x, y, z, shape (t, 7); level towards x where no attitude was recorded."""
    poses = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(time), 1))
    poses[:, :3] = series.at(time)[:, :3]
    if series.value.shape[1] >= 7:
        nearest = np.clip(np.searchsorted(series.time, time), 0, len(series) - 1)
        poses[:, 3:] = series.value[nearest][:, [6, 3, 4, 5]]
    return poses


def _velocities(record: VehicleRecord, positions: Series, time: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return recorded velocities, else the slope of the positions, shape (t, 3)."""
    recorded = record.series.get("velocity")
    if recorded is not None and len(recorded):
        return recorded.at(time)[:, :3]
    if len(time) < 2:
        return np.zeros((len(time), 3))
    return np.gradient(positions.at(time)[:, :3], time, axis=0)


def _events(recording: Recording) -> list[dict[str, Any]]:
    found = []
    for vehicle in recording.vehicles:
        found += [(time, vehicle.name, "mode", str(mode)) for time, mode in vehicle.modes]
        found += [(time, vehicle.name, "armed", "armed" if on else "disarmed") for time, on in vehicle.armed]
        found += [(time, vehicle.name, "command", str(text)) for time, text in vehicle.commands]
        found += [(time, vehicle.name, "text", str(text)) for time, _, text in vehicle.texts]
    found.sort()
    return [dict(zip(("time", "vehicle", "kind", "text"), row, strict=True)) for row in found[:_MOST_EVENTS]]
