"""The regions of a floor that vehicles share: squares, of which those are active that still have something to see."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.exploration.floor_map import UNKNOWN, FloorMap
from xtdrone_planning.exploration.frontiers import Cell, Frontier, Ways
from xtdrone_planning.exploration.settings import ExplorationSettings
from xtdrone_planning.exploration.tours import divide, division_cost

Array = NDArray[np.float64]

_UNKNOWN_SHARE = 0.3  # of a region, from which on it is active without a frontier
_GAIN = 0.85  # a new division must cost at most this part of the present one
_NO_WAY = 1e4  # m
_UNKNOWN_COST = 1.5  # of a metre through unknown space, against one through free space


class Regions:
    """The regions of a floor."""

    def __init__(self, settings: ExplorationSettings, floor: FloorMap) -> None:
        """Lay the squares over the bounds."""
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

    def divided(
        self,
        here: Cell,
        there: Cell,
        mine: frozenset[int],
        theirs: frozenset[int],
        frontiers: list[Frontier],
        clearance: float,
    ) -> tuple[frozenset[int], frozenset[int]]:
        """Return which regions the vehicle at ``here`` and the one at ``there`` visit best; both sets may overlap.

        Ways through unknown space count as free ones that are longer. A division that is hardly better than the present
        one is not worth turning round for: the present one is returned then.
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
        """Return the cell that stands for a region: its nearest frontier's, or the open one nearest to its middle."""
        seen = [f for f in frontiers if f.view is not None and self.of(f.centre) == region]
        if seen:
            return min(seen, key=lambda f: (f.way, f.centre)).centre
        own = np.argwhere((self._numbers == region) & (self._floor.distance > 0.5))
        if not len(own):
            return self._middles[region]
        i, j = own[((own - self._middles[region]) ** 2).sum(axis=1).argmin()].tolist()
        return i, j

    def _work(self, region: int) -> float:
        """Return the way within a region, m, by its unknown area."""
        unknown = (self._numbers == region) & (self._floor.values == UNKNOWN) & self._floor.inside
        return math.sqrt(float(np.count_nonzero(unknown))) * self._floor.cell


def _tour(costs: Array, start: int, nodes: list[int]) -> list[int]:
    """Return a short route from a start through nodes, numbers in ``costs``."""
    chosen = [start, *nodes]
    return [chosen[n] for n in divide(costs[np.ix_(chosen, chosen)], 1)[0]]
