"""Nearest position with enough clearance for a vehicle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.mapping.voxel_grid import VoxelGrid

Array = NDArray[np.float64]

_REACH = 2.0  # m


def nearest_clear(grid: VoxelGrid, place: Array, clearance: float) -> Array:
    """Return the position nearest to ``place``, at the same height, that is at least ``clearance`` m from all
    obstacles.

    Args:
        grid: the map.
        place: (3,) m in map.
        clearance: from the centre of an occupied voxel, m.

    Returns:
        (3,) m in map: ``place`` itself if it is clear, outside the map, or if no position within 2 m is clear; else the
        centre of a voxel, at the height of ``place``.
    """
    if not grid.is_inside(place):
        return np.array(place, float)
    i, j, k = grid.index(place)
    if grid.distance[i, j, k] >= clearance:
        return np.array(place, float)
    reach = round(_REACH / grid.resolution)
    low = np.maximum((i - reach, j - reach), 0)
    layer = grid.distance[low[0] : i + reach + 1, low[1] : j + reach + 1, k]
    clear = np.argwhere(layer >= clearance) + low
    if not len(clear):
        return np.array(place, float)
    middles = grid.middle(np.column_stack([clear, np.full(len(clear), k)]))
    away = ((middles[:, :2] - place[:2]) ** 2).sum(axis=1)
    nearest = int(away.argmin())
    if away[nearest] > _REACH * _REACH:
        return np.array(place, float)
    return np.array([*middles[nearest, :2], place[2]])
