"""Map of a floor at flight height, merged from slices of local maps and from the other vehicles' maps.

Cells are those of nav_msgs/OccupancyGrid: occupancy probability in percent, -1 for unknown. Cells through
which this vehicle has flown stay free: an obstacle seen there was a passing vehicle.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.exploration.settings import ExplorationSettings
from xtdrone_planning.mapping.distance_field import distance_field

Array = NDArray[np.float64]
Cells = NDArray[np.int8]

UNKNOWN, FLOWN, FREE, OCCUPIED = -1, 0, 10, 100
OCCUPIED_FROM = 50
_FARTHEST = 3.0  # m


class FloorMap:
    """A floor.

    Attributes:
        cell: side of a cell, m.
        first: (2,) index of the lowest cell, counted from the origin of map.
        own: (nx, ny) int8, what this vehicle has seen.
        values: (nx, ny) int8, merged with the others' maps; see ``merge``.
        inside: (nx, ny) whether a cell belongs to the area to explore.
        distance: (nx, ny) float32 m to the nearest occupied cell, at most 3; see ``merge``.
    """

    def __init__(self, settings: ExplorationSettings) -> None:
        """Start with an unknown floor."""
        self.cell = settings.cell
        x0, y0, x1, y1 = settings.bounds
        low = np.array([x0, y0]) - settings.margin
        high = np.array([x1, y1]) + settings.margin
        self.first = np.floor(low / self.cell + 1e-6).astype(np.int64)
        shape = tuple((np.ceil(high / self.cell - 1e-6).astype(np.int64) - self.first).tolist())
        self.own: Cells = np.full(shape, UNKNOWN, np.int8)
        x, y = (self.middles(np.arange(n), axis) for axis, n in enumerate(shape))
        self.inside = np.outer((x > x0) & (x < x1), (y > y0) & (y < y1))
        self._others: dict[str, Cells] = {}
        self.distance = np.full(shape, _FARTHEST, np.float32)
        self.values = self.own.copy()

    def middles(self, numbers: NDArray[np.int64], axis: int) -> Array:
        """Return the centres, m in map, of the cells with these indices along axis 0 or 1."""
        return np.asarray((numbers + self.first[axis] + 0.5) * self.cell, float)

    def middle(self, cell: tuple[int, int]) -> Array:
        """Return the centre of a cell, (2,) m in map."""
        return np.asarray((np.array(cell) + self.first + 0.5) * self.cell, float)

    def index(self, place: Array) -> tuple[int, int]:
        """Return the cell of a position, (2,) or longer, m in map; outside the map, the nearest cell."""
        numbers = np.floor(np.asarray(place)[:2] / self.cell).astype(np.int64) - self.first
        i, j = np.clip(numbers, 0, np.array(self.own.shape) - 1).tolist()
        return i, j

    def enter(self, corner: Array, values: Cells) -> None:
        """Insert a slice of a local map: its known cells replace those of the floor.

        Args:
            corner: (2,) lowest corner of the slice, m in map, aligned with the cells.
            values: (nx, ny) FREE, OCCUPIED or UNKNOWN, of cells of the same side.
        """
        into, part = _overlap(self.own, np.rint(corner / self.cell).astype(np.int64) - self.first, values)
        here = self.own[into]
        np.copyto(here, values[part], where=(values[part] != UNKNOWN) & (here != FLOWN))

    def fly_through(self, place: Array, radius: float) -> None:
        """Mark the cells within ``radius`` m of the vehicle's position ``place``, (2,) m in map, as permanently
        free."""
        reach = math.ceil(radius / self.cell)
        i, j = self.index(place)
        rows, columns = slice(max(0, i - reach), i + reach + 1), slice(max(0, j - reach), j + reach + 1)
        x = self.middles(np.arange(self.own.shape[0])[rows], 0) - place[0]
        y = self.middles(np.arange(self.own.shape[1])[columns], 1) - place[1]
        self.own[rows, columns][x[:, None] ** 2 + y**2 <= radius**2] = FLOWN

    def hear(self, vehicle: str, origin: Array, turn: float, values: Cells) -> None:
        """Keep the latest map of another vehicle, for the next ``merge``.

        Args:
            vehicle: its name.
            origin: (2,) lowest corner of the other map, m in this vehicle's map frame.
            turn: counter-clockwise angle from the x axis of map to that of the other map, rad.
            values: (nx, ny) of cells of the same side.
        """
        self._others[vehicle] = self._resample(origin, turn, values)

    def _resample(self, origin: Array, turn: float, values: Cells) -> Cells:
        """Resample another map into the cells of this one: nearest cell at each centre."""
        x, y = (self.middles(np.arange(n), axis) - origin[axis] for axis, n in enumerate(self.own.shape))
        c, s = math.cos(turn), math.sin(turn)
        i = np.floor((c * x[:, None] + s * y) / self.cell + 1e-9).astype(np.int64)
        j = np.floor((c * y - s * x[:, None]) / self.cell + 1e-9).astype(np.int64)
        within = (i >= 0) & (i < values.shape[0]) & (j >= 0) & (j < values.shape[1])
        placed = np.full(self.own.shape, UNKNOWN, np.int8)
        placed[within] = values[i[within], j[within]]
        return placed

    def merge(self) -> None:
        """Compute ``values`` and ``distance``. Precedence: cells flown through by any vehicle, own cells, other
        vehicles' cells."""
        values = self.own.copy()
        for other in self._others.values():
            np.copyto(values, other, where=(values == UNKNOWN) | (other == FLOWN))
        self.values = values
        evidence = values[:, :, None].astype(np.int16)
        distances = self.distance[:, :, None]
        distance_field(evidence, OCCUPIED_FROM, self.cell, _FARTHEST, distances)
        self.distance = distances[:, :, 0]

    def share_known(self) -> float:
        """Return the known fraction of the cells to explore."""
        return float((self.values[self.inside] != UNKNOWN).mean())


def _overlap(grid: Cells, offset: NDArray[np.int64], part: Cells) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return the overlapping slices of a grid, and of a patch that begins at the grid's cell ``offset``."""
    begin = np.maximum(offset, 0)
    end = np.maximum(np.minimum(offset + part.shape, grid.shape), begin)
    into = tuple(slice(a, b) for a, b in zip(begin.tolist(), end.tolist(), strict=True))
    source = tuple(slice(a, b) for a, b in zip((begin - offset).tolist(), (end - offset).tolist(), strict=True))
    return into, source
