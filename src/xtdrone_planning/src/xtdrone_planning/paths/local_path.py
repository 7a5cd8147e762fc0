"""A path from the vehicle towards a goal on the local map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.mapping.voxel_grid import VoxelGrid
from xtdrone_planning.paths.grid_search import REACHED, search
from xtdrone_planning.paths.lines_of_sight import seen_count, without_corners

Array = NDArray[np.float64]

STOPPING_ROOM = 0.4
"""Clearance at the end of a path beyond that along it, m.

A vehicle whose air drag differs from ``PlannerSettings.drag`` overshoots when it stops: without compensation an iris
from 4 m/s by that much.
"""

_AT_GOAL = 1.0  # m; a path may end this close to its goal, as the next one reaches it
_ENTRIES = 400_000  # of the search's heap


@dataclass(frozen=True)
class LocalPath:
    """A path.

    Attributes:
        outcome: REACHED, BLOCKED or UNDECIDED; see ``grid_search``. REACHED also covers the edge of the map towards the
        goal.
        points: (n, 3) corners of its seen part, m in map, the start first; a single point if nothing ahead has been
        seen.
        ahead: (3,) point of the path, seen or not, 3 m from the start or at its end; the vehicle faces it.
        is_whole: whether the seen part ends at the goal.
    """

    outcome: int
    points: Array
    ahead: Array
    is_whole: bool


class PathQuery(NamedTuple):
    """Ends and constraints of a path to be searched.

    Attributes:
        start, goal: (3,) m in map; the start is within the map.
        clearance: least distance of the path to obstacles, m.
        radius: Radius of the disc that must have been seen around each point, m.
        heights: lowest and highest flight, m in map.
        farthest: maximum length of the path that is returned, m.
    """

    start: Array
    goal: Array
    clearance: float
    radius: float
    heights: tuple[float, float]
    farthest: float


class Search(Protocol):
    """Interface of the path searches: ``PathSearch`` and ``sampled_path.SampledSearch``."""

    def find(self, grid: VoxelGrid, query: PathQuery, distance: NDArray[np.float32] | None = None) -> LocalPath:
        """Search a path.

        Args:
            grid: the map.
            query: ends and constraints of the path.
            distance: distances to obstacles in place of the map's, m.
        """


class PathSearch:
    """Searches paths; holds the scratch arrays of the search."""

    def __init__(self, most: int) -> None:
        """Allocate the search.

        Args:
            most: maximum number of voxels that a search expands, which bounds its time.
        """
        self._most = most
        self._stamp = 0
        self._size = 0

    def find(self, grid: VoxelGrid, query: PathQuery, distance: NDArray[np.float32] | None = None) -> LocalPath:
        """Search a path by A*; see ``Search.find``."""
        self._prepare(grid)
        start, goal, heights = query.start, query.goal, query.heights
        distance = grid.distance if distance is None else distance
        places = [value / grid.resolution - grid.corner[2] for value in heights]
        first = np.array(grid.index(start))
        layers = grid.evidence.shape[2]
        lowest = int(np.clip(np.ceil(places[0] - 0.5), 0, layers - 1))
        highest = int(np.clip(np.floor(places[1] - 0.5), lowest, layers - 1))
        outcome, voxels = search(
            distance, grid.evidence, query.clearance, first, goal / grid.resolution - grid.corner,
            min(lowest, first[2]), max(highest, first[2]), self._most,
            self._costs, self._parents, self._stamps, self._stamp, self._heap, self._keys,
        )  # fmt: skip
        points = grid.middle(voxels)
        points[0] = start
        if outcome == REACHED and grid.is_inside(goal) and heights[0] <= goal[2] <= heights[1]:
            points = np.vstack([points[:-1] if len(points) > 1 else points, goal])
        return seen_path(grid, distance, int(outcome), points, query)

    def _prepare(self, grid: VoxelGrid) -> None:
        if self._size != grid.evidence.size:
            self._size = grid.evidence.size
            self._costs = np.zeros(self._size, np.float32)
            self._parents = np.zeros(self._size, np.int32)
            self._stamps = np.zeros(self._size, np.int32)
            self._heap = np.zeros(_ENTRIES, np.int32)
            self._keys = np.zeros(_ENTRIES, np.float32)
            self._stamp = 0
        self._stamp += 1


def seen_path(
    grid: VoxelGrid, distance: NDArray[np.float32], outcome: int, points: Array, query: PathQuery
) -> LocalPath:
    """Return the seen part of a path, without unnecessary corners.

    A path that does not end at its goal ends where there is room to stop, if there is such a place: a vehicle that
    finds no further trajectory in time comes to rest there.

    Args:
        grid: the map.
        distance: distances to obstacles, m.
        outcome: Outcome of the search.
        points: (n, 3) m in map, at most a voxel's diagonal apart.
        query: what was searched.
    """
    corner, resolution, radius = grid.corner, grid.resolution, query.radius
    seen = max(1, seen_count(grid.evidence, corner, resolution, points, radius, 2.0 * radius, query.farthest))
    ahead = points[min(len(points) - 1, round(3.0 / resolution))]
    is_whole = outcome == REACHED and seen == len(points) and bool(np.allclose(points[-1], query.goal))
    if not is_whole and np.linalg.norm(points[seen - 1] - query.goal) > _AT_GOAL:
        seen = _with_room_to_stop(grid, distance, points[:seen], query.clearance + STOPPING_ROOM)
    kept = without_corners(distance, grid.evidence, corner, resolution, points[:seen], query.clearance, radius)
    return LocalPath(outcome, kept, ahead, is_whole)


def _with_room_to_stop(grid: VoxelGrid, distance: NDArray[np.float32], points: Array, least: float) -> int:
    """Return the number of points up to the last one that is this far from obstacles, m; all of them if none is."""
    cells = np.floor(points / grid.resolution).astype(np.int64) - grid.corner
    clear = np.flatnonzero(distance[tuple(cells.T)] >= least)
    return int(clear[-1]) + 1 if len(clear) and clear[-1] > 0 else len(points)


_REACH = 2.0  # m


def nearest_clear(grid: VoxelGrid, place: Array, clearance: float) -> Array:
    """Return the position nearest to ``place``, at the same height, that is at least ``clearance`` m from all
    obstacles.

    Args:
        grid: the map.
        place: (3,) m in map.
        clearance: Clearance from the centre of an occupied voxel, m.

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
