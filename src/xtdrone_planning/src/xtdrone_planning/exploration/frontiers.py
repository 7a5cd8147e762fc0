"""Frontiers of a floor: boundaries between free and unknown space, each with a cell to view it from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.exploration.floor_kernels import label_clusters, mark_frontiers, nearest_view, ways_from
from xtdrone_planning.exploration.floor_map import FloorMap

Array = NDArray[np.float64]
Cell = tuple[int, int]

_EXTENT = 1.5  # m: maximum extent of a cluster from its first cell
_SIGHT = 2.5  # m: maximum distance from which a frontier is viewed


@dataclass(frozen=True)
class Frontier:
    """A cluster of frontier cells.

    Attributes:
        cells: (n, 2).
        centre: the cell nearest to their mean.
        view: reachable cell to view it from; None: unreachable.
        way: cost of the path there, m.
    """

    cells: NDArray[np.int64]
    centre: Cell
    view: Cell | None
    way: float


class Ways:
    """Shortest paths on a floor from one cell."""

    def __init__(self, floor: FloorMap, start: Cell, clearance: float, unknown: float = 0.0) -> None:
        """Compute the paths; see ``floor_kernels.ways_from``."""
        self._ny = floor.values.shape[1]
        self.costs = np.empty(floor.values.shape, np.float32)
        self._parents = np.empty(floor.values.shape, np.int32)
        ways_from(
            floor.values, floor.distance, clearance, unknown, floor.cell, np.array(start), self.costs, self._parents
        )

    def route(self, target: Cell) -> list[Cell]:
        """Return the cells of the path from the start to ``target``."""
        cells = [target]
        node = int(self._parents[target])
        while node >= 0:
            cells.append((node // self._ny, node % self._ny))
            node = int(self._parents[cells[-1]])
        return cells[::-1]


def find_frontiers(floor: FloorMap, ways: Ways, given_up: NDArray[np.bool_], smallest: int) -> list[Frontier]:
    """Return the frontiers of a floor, in the order of their first cells.

    Args:
        floor: merged.
        ways: Paths from the vehicle.
        given_up: (nx, ny) cells that no longer count as frontiers.
        smallest: clusters of fewer cells are ignored.
    """
    frontier = np.empty(floor.values.shape, np.bool_)
    mark_frontiers(floor.values, floor.inside, given_up, frontier)
    labels = np.empty(frontier.shape, np.int32)
    count = label_clusters(frontier, round(_EXTENT / floor.cell), labels, np.empty(frontier.size, np.int32))
    cells = np.argwhere(labels)
    numbers = labels[cells[:, 0], cells[:, 1]]
    order = np.argsort(numbers, kind="stable")
    parts = np.split(cells[order], np.searchsorted(numbers[order], np.arange(2, count + 1)))
    return [_frontier(floor, ways, part) for part in parts if len(part) >= smallest]


def _frontier(floor: FloorMap, ways: Ways, cells: NDArray[np.int64]) -> Frontier:
    i, j = cells[((cells - cells.mean(axis=0)) ** 2).sum(axis=1).argmin()].tolist()
    a, b = nearest_view(floor.values, ways.costs, np.array([i, j]), round(_SIGHT / floor.cell), floor.cell)
    view = (int(a), int(b)) if a >= 0 else None
    return Frontier(cells, (i, j), view, math.inf if view is None else float(ways.costs[view]))
