"""Positions of vehicles, from whichever topics were recorded. All are ENU, metres.

All positions carry their own time stamps, except the true ones of /gazebo/model_states. The recorder's clock may be
seconds off in a simulation that runs fast on a busy machine, so the times of these are reconstructed from their
constant rate and are correct to a few steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import median_filter

from xtdrone_interaction.recording.distances import least_distances
from xtdrone_interaction.recording.series_in_bounded_memory import Array, Series

_BASE_STEP = 0.004  # s; every period of the simulator is a multiple of it
_MEDIAN_SPAN = 10.0  # s; within any such span the recorder's clock is right most of the time
_EARTH = 6371008.8  # m, mean radius
_FARTHEST = 1e7  # m, a quarter of the way around the earth; anything beyond is damaged
_APART = 5.0  # m between origins; within the error of GPS

FleetSeries = Mapping[str, dict[str, Series]]
"""Series by vehicle and quantity, as in :attr:`~xtdrone_interaction.recording.recorded_flight.VehicleRecord.series`."""


@dataclass(frozen=True)
class FleetTrack:
    """Positions of a whole fleet on common times.

    Attributes:
        source: description of the positions, for captions and reports.
        time: shape (t,), increasing, s.
        position: shape (t, n, 3), metres ENU.
    """

    source: str
    time: Array
    position: Array

    def between(self, start: float, end: float) -> FleetTrack:
        """Return the part with ``start <= time <= end``."""
        part = self.part(start, end)
        return FleetTrack(self.source, self.time[part], self.position[part])

    def part(self, start: float, end: float) -> slice:
        """Return the rows with ``start <= time <= end``."""
        return slice(int(np.searchsorted(self.time, start, "left")), int(np.searchsorted(self.time, end, "right")))

    @cached_property
    def least_distance(self) -> Array:
        """The minimum distance between any two vehicles at each time, m, shape (t,)."""
        return least_distances(self.position)


def fleet_track(source: str, series: Sequence[Series | None]) -> FleetTrack | None:
    """Return positions interpolated at the first vehicle's times; None unless every vehicle has some.

    Args:
        source: description of the positions.
        series: position of each vehicle, m, (t, 3). A vehicle without messages at the beginning or the end is taken to
            stand where it is first or last known.
    """
    known = [entry for entry in series if entry is not None and len(entry)]
    if not known or len(known) < len(series):
        return None
    time = np.unique(known[0].time)  # a message may be recorded twice
    position = np.empty((len(time), len(known), 3))
    for i, entry in enumerate(known):
        stamps, rows = np.unique(entry.time, return_index=True)
        if np.array_equal(stamps, time):
            position[:, i] = entry.value[rows, :3]
            continue
        for axis in range(3):
            position[:, i, axis] = np.interp(time, stamps, entry.value[rows, axis])
    return FleetTrack(source, time, position)


def regular_times(stamps: Array) -> Array:
    """Return when the messages of a topic with a constant rate were sent.

    The k-th was sent at k periods plus an offset, which grows when messages are lost: the running median of the
    difference to the recorder's clock.

    Args:
        stamps: when they were recorded, shape (t,), s, in the order of sending.
    """
    count = len(stamps)
    period = _BASE_STEP * round((stamps[-1] - stamps[0]) / max(1, count - 1) / _BASE_STEP)
    if period == 0.0:  # faster than our simulator, or a single message
        return np.maximum.accumulate(stamps)
    offset = stamps - period * np.arange(count)
    smooth = median_filter(offset, size=min(count, round(_MEDIAN_SPAN / period)), mode="nearest")
    return np.maximum.accumulate(period * np.arange(count) + smooth)


def complete(fleet: FleetSeries) -> list[str]:
    """Add missing "pose" and "velocity" series from odometry and GPS; return notes about doubtful positions.

    GPS positions are relative to the first fix of the first vehicle.
    """
    fixes = {name: _fixes(series["global"]) for name, series in fleet.items() if "global" in series}
    fixes = {name: found for name, found in fixes.items() if len(found)}
    datum = next((found.value[0] for found in fixes.values()), np.zeros(3))
    by_gps, origins = [], []
    for name, series in fleet.items():
        _split_odometry(series)
        if name in fixes:
            positions = local(fixes[name].value, datum)
            if "pose" in series:
                origins.append(_origin(series["pose"], Series(fixes[name].time, positions)))
            else:
                level = np.tile([0.0, 0.0, 0.0, 1.0], (len(positions), 1))
                series["pose"] = Series(fixes[name].time, np.hstack([positions, level]))
                by_gps.append(name)
        _add_velocity(series)
    notes = []
    if by_gps:
        notes.append(f"positions of {', '.join(by_gps)} are from GPS, relative to the first fix of {next(iter(fixes))}")
    known = np.array([origin for origin in origins if np.isfinite(origin).all()]).reshape(-1, 2)
    apart = float(np.hypot(*np.ptp(known, axis=0))) if len(known) else 0.0
    if apart > _APART or (by_gps and len(by_gps) < len(fleet)):
        where = f" begin up to {apart:.0f} m apart according to GPS" if apart > _APART else " have several origins"
        notes.append(f"the vehicles' positions{where}: distances between vehicles are wrong")
    return notes


def plausible(series: Series) -> Series:
    """Return the rows that can be positions or velocities; unknown ones (NaN) stay."""
    good = ~(np.abs(series.value) > _FARTHEST).any(axis=1)
    return series if good.all() else Series(series.time[good], series.value[good])


def _fixes(series: Series) -> Series:
    """Return the known latitudes, longitudes and altitudes."""
    good = np.isfinite(series.value).all(axis=1)
    return Series(series.time[good], series.value[good])


def _split_odometry(series: dict[str, Series]) -> None:
    odometry = series.pop("odometry", None)
    if odometry is not None:
        velocity = _rotated(odometry.value[:, 3:7], odometry.value[:, 7:10])  # MAVROS gives it in the body frame
        series.setdefault("pose", Series(odometry.time, odometry.value[:, :7]))
        series.setdefault("velocity", Series(odometry.time, velocity))


def _add_velocity(series: dict[str, Series]) -> None:
    pose = series.get("pose")
    if pose is None or "velocity" in series:
        return
    time, rows = np.unique(pose.time, return_index=True)  # stamps of a simulation may repeat
    if len(time) > 2:
        series["velocity"] = Series(time, np.gradient(pose.value[rows, :3], time, axis=0))


def _origin(pose: Series, positions: Series) -> Array:
    """Return the origin of a vehicle's local frame in the frame of ``positions``, (2,); NaN if unknown."""
    away = positions.value[:, :2] - pose.at(positions.time)[:, :2]
    away = away[np.isfinite(away).all(axis=1)]
    return np.median(away, axis=0) if len(away) else np.full(2, np.nan)


def _rotated(quaternion: Array, vector: Array) -> Array:
    """Return vectors, (t, 3), rotated by quaternions (x, y, z, w), (t, 4)."""
    axis, w = quaternion[:, :3], quaternion[:, 3:]
    twice = 2.0 * np.cross(axis, vector)
    return np.asarray(vector + w * twice + np.cross(axis, twice))


def local(fix: Array, datum: Array) -> Array:
    """Return positions, (t, 3), m ENU from a datum.

    Args:
        fix: latitude and longitude in degrees, altitude in m, (t, 3).
        datum: the same, (3,).
    """
    north = np.radians(fix[:, 0] - datum[0]) * _EARTH
    east = np.radians(fix[:, 1] - datum[1]) * _EARTH * math.cos(math.radians(datum[0]))
    return np.column_stack([east, north, fix[:, 2] - datum[2]])
