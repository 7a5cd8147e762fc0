"""Global path on a plane map, by A*."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.navigation.level_map import LevelMap
from xtdrone_planning.paths.grid_search import REACHED, mark_reachable, search

Array = NDArray[np.float64]

_ENTRIES_PER_CELL = 2  # of the search's heap


class PathError(ValueError):
    """There is no path; the message gives the reason."""


def _nearest_reachable(level: LevelMap, start: Array, goal: Array, clearance: float, tolerance: float) -> Array | None:
    """Return the place (2,), m in map, nearest to a goal to which there is a path; None: there is none within
    ``tolerance``, m."""
    reached = np.zeros(level.distance.shape, np.bool_)
    first = np.array([*level.index(start), 0], np.int64)
    mark_reachable(level.distance, clearance, first, reached, np.empty(reached.size, np.int32))
    cells = np.argwhere((reached & (level.distance >= clearance))[:, :, 0])
    places = level.middle(cells)
    away = np.hypot(*(places - goal[:2]).T)
    if not len(away) or away.min() > tolerance:
        return None
    return places[int(away.argmin())]


class GlobalSearch:
    """Searches paths; holds the scratch arrays of the search."""

    def __init__(self) -> None:
        """Allocate the search."""
        self._size = self._stamp = 0

    def find(self, level: LevelMap, start: Array, goal: Array, clearance: float) -> Array:
        """Return the path (n, 2), m in map, from start to goal.

        Args:
            level: the map, with all distances up to date.
            start, goal: (2,) m in map.
            clearance: minimum distance between path and occupied cells, m; near the start it may be less while it
            increases.

        Raises:
            PathError: there is no path.
        """
        for what, place in (("vehicle", start), ("goal", goal)):
            if not level.is_inside(place):
                raise PathError(f"the {what} is outside the map")
        away = level.away(goal)
        if away < clearance:
            raise PathError(f"the goal is {away:.1f} m from an obstacle, {clearance:.1f} m are needed")
        self._prepare(level.evidence.size)
        first = np.array([*level.index(start), 0], np.int64)
        last = np.array([*level.index(goal), 0], float) + 0.5
        outcome, cells = search(
            level.distance, level.evidence, clearance, first, last, 0, 0, level.evidence.size,
            self._costs, self._parents, self._stamps, self._stamp, self._heap, self._keys,
        )  # fmt: skip
        if outcome != REACHED:
            raise PathError("there is no path to the goal on the map")
        points = level.middle(cells)
        points[0] = start[:2]
        return np.vstack([points[:-1] if len(points) > 1 else points, goal[:2]])

    def find_near(self, level: LevelMap, start: Array, goal: Array, clearance: float, tolerance: float) -> Array:
        """Return the path (n, 2), m in map, to the goal, or else to the nearest place to which there is one.

        Args:
            level, start, goal, clearance: see ``find``.
            tolerance: farthest distance of that place from the goal, m.

        Raises:
            PathError: there is none; the reason is that of the goal itself.
        """
        try:
            return self.find(level, start, goal, clearance)
        except PathError as error:
            reason = error
        place = _nearest_reachable(level, start, goal, clearance, tolerance) if level.is_inside(start) else None
        if place is None:
            raise reason
        return self.find(level, start, place, clearance)

    def _prepare(self, size: int) -> None:
        if self._size != size:
            self._size, self._stamp = size, 0
            self._costs = np.zeros(size, np.float32)
            self._parents, self._stamps = np.zeros(size, np.int32), np.zeros(size, np.int32)
            entries = _ENTRIES_PER_CELL * size + 64
            self._heap, self._keys = np.zeros(entries, np.int32), np.zeros(entries, np.float32)
        self._stamp += 1
