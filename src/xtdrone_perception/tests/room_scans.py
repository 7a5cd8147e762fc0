"""Scans of a lidar with 16 rings in a room, in closed form, for tests of odometry."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.clouds import PointScan
from xtdrone_common.pose_matrices import inverse

Array = NDArray[np.float64]

RANGE = 60.0  # m
PERIOD = 0.1  # s
ROOM = ((-12.0, -8.0, 0.0), (14.0, 10.0, 9.0))  # corners, m
_CORNERS = ((5.0, 4.0, 0.0), (7.0, 6.5, 5.0))  # of a block in it


def directions(rings: int = 16, columns: int = 512) -> Array:
    """Return unit directions (n, 3) in the lidar's frame, column by column, counter-clockwise."""
    azimuth = np.repeat(np.linspace(-np.pi, np.pi, columns, endpoint=False), rings)
    height = np.tile(np.radians(np.linspace(-15.0, 15.0, rings)), columns)
    return np.stack([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)], axis=1)


def ranges(origins: Array, rays: Array, room: tuple[tuple[float, ...], tuple[float, ...]] | None = ROOM) -> Array:
    """Return the ranges (n,) of rays from inside a room with a block; without a room, of the plane z = 0."""
    rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)  # no 0 / 0
    with np.errstate(divide="ignore"):
        if room is None:
            down = -origins[:, 2] / rays[:, 2]
            return np.where(down > 0.0, down, np.inf)
        walls = np.where(rays > 0.0, np.array(room[1]), np.array(room[0]))
        found = ((walls - origins) / rays).min(axis=1)
        low, high = ((np.array(corner) - origins) / rays for corner in _CORNERS)
        enter, leave = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
    return np.where((enter < leave) & (enter > 0.0), np.minimum(enter, found), found)


def room_scan(
    begin: Array,
    end: Array,
    seed: int,
    room: tuple[tuple[float, ...], tuple[float, ...]] | None = ROOM,
    noise: float = 0.02,
) -> PointScan:
    """Return a scan between two poses (4, 4), the second after one period; the lidar is at the body's origin."""
    rays = directions()
    times = np.repeat(np.linspace(0.0, PERIOD, 512, endpoint=False), 16)
    share = (times / PERIOD)[:, None]
    origins = begin[:3, 3] + share * (end[:3, 3] - begin[:3, 3])
    angle = np.arctan2(*(inverse(begin) @ end)[[1, 0], [0, 0]]) * share[:, 0]
    sin, cos = np.sin(angle), np.cos(angle)
    turned = np.stack([cos * rays[:, 0] - sin * rays[:, 1], sin * rays[:, 0] + cos * rays[:, 1], rays[:, 2]], axis=1)
    found = ranges(origins, turned @ begin[:3, :3].T, room)
    seen = found < RANGE
    measured = found[seen] + noise * np.random.default_rng(seed).standard_normal(seen.sum())
    return PointScan(rays[seen] * measured[:, None], times[seen], seed)
