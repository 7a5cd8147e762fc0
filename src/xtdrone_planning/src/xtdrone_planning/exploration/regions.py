"""Square regions of a floor that are divided among vehicles; a region is active while something in it is unexplored."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.exploration.floor_map import UNKNOWN, FloorMap
from xtdrone_planning.exploration.frontiers import Cell, Frontier, Ways
from xtdrone_planning.exploration.settings import ExplorationSettings
from xtdrone_planning.exploration.tours import divide, division_cost

Array = NDArray[np.float64]

_UNKNOWN_SHARE = 0.3  # unknown fraction of a region above which it is active even without a frontier
_GAIN = 0.85  # a new division must cost at most this fraction of the current one
_NO_WAY = 1e4  # m
_UNKNOWN_COST = 1.5  # cost of a metre through unknown space, relative to free space


class Regions:
    """The regions of a floor."""

    def __init__(self, settings: ExplorationSettings, floor: FloorMap) -> None:
        """Divide the bounds into squares."""
        self._floor = floor
        x0, y0, x1, y1 = settings.bounds
        nx = max(1, round((x1 - x0) / settings.region))
        ny = max(1, round((y1 - y0) / settings.region))
        self.count = nx * ny
        x, y = (floor.middles(np.arange(n), axis) for axis, n in enumerate(floor.values.shape))
        column = np.clip(np.floor((x - x0) / (x1 - x0) * nx).astype(np.int64), 0, nx - 1)
        row = np.clip(np.floor((y - y0) / (y1 - y0) * ny).astype(np.int64), 0, ny - 1)
        self._numbers = column[:, None] * ny + row
        self._cells = np.bincount(self._numbers[floor.inside], minlength=self.count)
        width, depth = (x1 - x0) / nx, (y1 - y0) / ny
        self._middles = [
            floor.index(np.array([x0 + (n // ny + 0.5) * width, y0 + (n % ny + 0.5) * depth]))
            for n in range(self.count)
        ]

    def of(self, cell: Cell) -> int:
        """Return the region of a cell."""
        return int(self._numbers[cell])

    def active(self, frontiers: list[Frontier]) -> frozenset[int]:
        """Return the regions that have a reachable frontier, or are largely unknown."""
        unknown = (self._floor.values == UNKNOWN) & self._floor.inside
        counts = np.bincount(self._numbers[unknown], minlength=self.count)
        largely = np.flatnonzero(counts > _UNKNOWN_SHARE * np.maximum(self._cells, 1)).tolist()
        return frozenset(largely) | {self.of(frontier.centre) for frontier in frontiers if frontier.view is not None}

    def divide(
        self,
        here: Cell,
        there: Cell,
        mine: frozenset[int],
        theirs: frozenset[int],
        frontiers: list[Frontier],
        clearance: float,
    ) -> tuple[frozenset[int], frozenset[int]]:
        """Divide regions between the vehicle at ``here`` and the one at ``there``; the two given sets may overlap.

        Paths through unknown space cost more than through free space. The current division is kept unless the new one
        is clearly cheaper, so that vehicles do not turn back for a small gain.
        """
        order = sorted(mine | theirs)
        places = [here, there, *(self._place(region, frontiers) for region in order)]
        costs = np.zeros((len(places), len(places)))
        for n, place in enumerate(places):
            ways = Ways(self._floor, place, clearance, _UNKNOWN_COST).costs
            costs[n] = [float(ways[other]) for other in places]
        costs = 0.5 * (costs + costs.T)
        costs[:, 2:] += [self._work(region) for region in order]
        costs = np.where(np.isfinite(costs), costs, _NO_WAY)
        routes = divide(costs, 2)
        if not mine & theirs:
            present = [
                _tour(costs, start, [order.index(r) + 2 for r in sorted(own)])
                for start, own in enumerate((mine, theirs))
            ]
            if division_cost(costs, routes) > _GAIN * division_cost(costs, present):
                return mine, theirs
        new_mine, new_theirs = (frozenset(order[n - 2] for n in route[1:]) for route in routes)
        return new_mine, new_theirs

    def _place(self, region: int, frontiers: list[Frontier]) -> Cell:
        """Return the cell that represents a region: that of its nearest frontier, or the free cell nearest to its
        centre."""
        seen = [f for f in frontiers if f.view is not None and self.of(f.centre) == region]
        if seen:
            return min(seen, key=lambda f: (f.way, f.centre)).centre
        own = np.argwhere((self._numbers == region) & (self._floor.distance > 0.5))
        if not len(own):
            return self._middles[region]
        i, j = own[((own - self._middles[region]) ** 2).sum(axis=1).argmin()].tolist()
        return i, j

    def _work(self, region: int) -> float:
        """Estimate the path length within a region, m, from its unknown area."""
        unknown = (self._numbers == region) & (self._floor.values == UNKNOWN) & self._floor.inside
        return math.sqrt(float(np.count_nonzero(unknown))) * self._floor.cell


def _tour(costs: Array, start: int, nodes: list[int]) -> list[int]:
    """Return a short route from a start through nodes, given as indices into ``costs``."""
    chosen = [start, *nodes]
    return [chosen[n] for n in divide(costs[np.ix_(chosen, chosen)], 1)[0]]
