"""Where vehicles were, of whichever topics say it: local position, odometry or GPS. Places are ENU, metres."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from xtdrone_interaction.analysis.columns import Array, Series

_EARTH = 6371008.8  # m, mean radius
_FARTHEST = 1e7  # m, a quarter of the way around the earth; what is farther away is damaged
_APART = 5.0  # m between origins; GPS is not sure of less

Fleet = Mapping[str, dict[str, Series]]
"""Series by vehicle and what they are, as in :class:`~xtdrone_interaction.analysis.flight.Vehicle`."""


def complete(fleet: Fleet) -> list[str]:
    """Fill in "pose" and "velocity" where their own topics were not recorded, and return what is to be said of places.

    Odometry is taken apart; of GPS, places count from the first fix of the first vehicle.
    """
    fixes = {name: _fixes(series["global"]) for name, series in fleet.items() if "global" in series}
    fixes = {name: found for name, found in fixes.items() if len(found)}
    datum = next((found.value[0] for found in fixes.values()), np.zeros(3))
    by_gps, origins = [], []
    for name, series in fleet.items():
        _take_odometry(series)
        if name in fixes:
            places = local(fixes[name].value, datum)
            if "pose" in series:
                origins.append(_origin(series["pose"], Series(fixes[name].time, places)))
            else:
                rest = np.tile([0.0, 0.0, 0.0, 1.0], (len(places), 1))
                series["pose"] = Series(fixes[name].time, np.hstack([places, rest]))
                by_gps.append(name)
        _take_velocity(series)
    notes = []
    if by_gps:
        notes.append(f"places of {', '.join(by_gps)} are of GPS, from the first fix of {next(iter(fixes))}")
    known = np.array([origin for origin in origins if np.isfinite(origin).all()]).reshape(-1, 2)
    apart = float(np.hypot(*np.ptp(known, axis=0))) if len(known) else 0.0
    if apart > _APART or (by_gps and len(by_gps) < len(fleet)):
        where = (
            f" begin at places up to {apart:.0f} m apart, as GPS says" if apart > _APART else " have several origins"
        )
        notes.append(f"the vehicles' places{where}: distances between vehicles are not true")
    return notes


def nearby(series: Series) -> Series:
    """Return the rows whose numbers can be places or velocities; what is not known (NaN) stays."""
    good = ~(np.abs(series.value) > _FARTHEST).any(axis=1)
    return series if good.all() else Series(series.time[good], series.value[good])


def _fixes(series: Series) -> Series:
    """Return the latitudes, longitudes and altitudes that are known."""
    good = np.isfinite(series.value).all(axis=1)
    return Series(series.time[good], series.value[good])


def _take_odometry(series: dict[str, Series]) -> None:
    odometry = series.pop("odometry", None)
    if odometry is not None:
        turned = _rotated(odometry.value[:, 3:7], odometry.value[:, 7:10])  # MAVROS gives it in the body's axes
        series.setdefault("pose", Series(odometry.time, odometry.value[:, :7]))
        series.setdefault("velocity", Series(odometry.time, turned))


def _take_velocity(series: dict[str, Series]) -> None:
    pose = series.get("pose")
    if pose is None or "velocity" in series:
        return
    time, rows = np.unique(pose.time, return_index=True)  # stamps of a simulation may repeat
    if len(time) > 2:
        series["velocity"] = Series(time, np.gradient(pose.value[rows, :3], time, axis=0))


def _origin(pose: Series, places: Series) -> Array:
    """Return where a vehicle's local frame has its origin, shape (2,), by its places in another; NaN if unknown."""
    away = places.value[:, :2] - pose.at(places.time)[:, :2]
    away = away[np.isfinite(away).all(axis=1)]
    return np.median(away, axis=0) if len(away) else np.full(2, np.nan)


def _rotated(quaternion: NDArray[np.float64], vector: Array) -> Array:
    """Return vectors turned by quaternions (x, y, z, w), both (t, ...)."""
    axis, w = quaternion[:, :3], quaternion[:, 3:]
    twice = 2.0 * np.cross(axis, vector)
    return np.asarray(vector + w * twice + np.cross(axis, twice))


def local(fix: Array, datum: Array) -> Array:
    """Return places, (t, 3), from a datum, (3,): latitudes and longitudes in degrees, altitudes in metres."""
    north = np.radians(fix[:, 0] - datum[0]) * _EARTH
    east = np.radians(fix[:, 1] - datum[1]) * _EARTH * math.cos(math.radians(datum[0]))
    return np.column_stack([east, north, fix[:, 2] - datum[2]])
