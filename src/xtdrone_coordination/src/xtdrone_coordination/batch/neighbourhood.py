"""Search for near vehicles: a grid of cells, or the network's result.

The search costs about N times the number of near vehicles, not N times N. Its result is a list of vehicle numbers in
ascending order, so sums over it have the order of a loop over all vehicles.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_coordination.kernel import kernel
from xtdrone_coordination.known_swarm_state import NEVER

_FEW = 24  # vehicles: up to this number, comparing all pairs is as fast
_CROWD = 48  # near vehicles: from this number on, comparing all is faster than sorting
_MARGIN = 1.0 + 1e-6  # a cell exceeds the radius by more than rounding errors, up to _FAR cells away
_FAR = 1 << 20
_EMPTY = -1

UNUSABLE = -2
"""In the first bucket: the cells are not valid, and all pairs are compared."""


GRID = np.dtype(
    [
        ("x", np.int32),  # cell of the vehicle
        ("y", np.int32),
        ("z", np.int32),
        ("following", np.int32),  # next vehicle in the same bucket
        ("near", np.int32),  # list of the vehicles found near one vehicle, in the first entries
    ]
)
"""Row j of the grid: the cell of vehicle j, and entry j of the list of near vehicles."""


def make_grid(count: int) -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """Return an empty grid for ``count`` vehicles, shape (N,), and its buckets: the first vehicle of each."""
    buckets = np.zeros(1 << (4 * count).bit_length(), dtype=np.int32)
    buckets[0] = UNUSABLE
    return np.zeros(count, dtype=GRID), buckets


@kernel
def relative(positions: NDArray[Any], index: int, j: int) -> tuple[float, float, float]:
    """Return the vector from vehicle ``index`` to vehicle ``j``, m."""
    return (
        positions[j, 0] - positions[index, 0],
        positions[j, 1] - positions[index, 1],
        positions[j, 2] - positions[index, 2],
    )


@kernel
def fill_grid(
    positions: NDArray[Any], heard: NDArray[Any], radius: float, grid: NDArray[Any], buckets: NDArray[Any]
) -> None:
    """Sort the known vehicles into cells for searches within ``radius`` m; UNUSABLE for few or too distant ones."""
    if len(heard) <= _FEW or not _fill_cells(positions, heard, radius * _MARGIN, grid, buckets):
        buckets[0] = UNUSABLE


@kernel
def _fill_cells(
    positions: NDArray[Any], heard: NDArray[Any], size: float, grid: NDArray[Any], buckets: NDArray[Any]
) -> bool:
    """Sort the known vehicles into cells of ``size`` m, ascending in each bucket; False if one is too far away."""
    buckets[:] = _EMPTY
    for j in range(len(heard) - 1, -1, -1):
        if heard[j] == NEVER:
            continue
        x = math.floor(positions[j, 0] / size)
        y = math.floor(positions[j, 1] / size)
        z = math.floor(positions[j, 2] / size)
        if not (abs(x) < _FAR and abs(y) < _FAR and abs(z) < _FAR):
            return False
        entry = grid[j]
        entry.x, entry.y, entry.z = x, y, z
        bucket = _bucket(entry.x, entry.y, entry.z, len(buckets))
        entry.following = buckets[bucket]
        buckets[bucket] = j
    return True


@kernel
def _bucket(x: int, y: int, z: int, buckets: int) -> int:
    return (x * 73856093 ^ y * 19349663 ^ z * 83492791) & (buckets - 1)


@kernel
def find_near(
    index: int,
    positions: NDArray[Any],
    heard: NDArray[Any],
    radius: float,
    grid: NDArray[Any],
    buckets: NDArray[Any],
    radio: Any,
) -> int:
    """List the known vehicles within ``radius`` m of a known one in the grid's ``near``; return their number.

    With a network, ``radio`` is the result of its ``near``, and the vehicles' positions are stored as received.
    """
    if radio is not None:
        return _find_by_radio(index, positions, radius, radio, grid)
    square = radius * radius
    if buckets[0] != UNUSABLE:
        found = _find_in_cells(index, positions, square, grid, buckets)
        if found < _CROWD:
            return found
    return _find_among_all(index, positions, heard, square, grid)


@kernel
def _find_among_all(index: int, positions: NDArray[Any], heard: NDArray[Any], square: float, grid: NDArray[Any]) -> int:
    """List the known vehicles whose squared distance to ``index`` is below ``square``."""
    found = 0
    for j in range(len(heard)):
        x, y, z = relative(positions, index, j)
        if x * x + y * y + z * z < square and j != index and heard[j] != NEVER:
            grid[found].near = j
            found += 1
    return found


@kernel
def _find_in_cells(
    index: int, positions: NDArray[Any], square: float, grid: NDArray[Any], buckets: NDArray[Any]
) -> int:
    """List the vehicles of the 27 cells around ``index`` whose squared distance is below ``square``, at most _CROWD."""
    cx, cy, cz = grid[index].x, grid[index].y, grid[index].z
    found = 0
    for ix in range(cx - 1, cx + 2):
        for iy in range(cy - 1, cy + 2):
            for iz in range(cz - 1, cz + 2):
                j = buckets[_bucket(ix, iy, iz, len(buckets))]
                while j != _EMPTY:
                    if grid[j].x == ix and grid[j].y == iy and grid[j].z == iz and j != index:
                        x, y, z = relative(positions, index, j)
                        if x * x + y * y + z * z < square:
                            if found == _CROWD:
                                return found
                            _insert(grid, found, j)
                            found += 1
                    j = grid[j].following
    return found


@kernel
def _insert(grid: NDArray[Any], found: int, j: int) -> None:
    """Insert ``j`` into the first ``found`` entries of the list, which are ascending."""
    place = found
    while place > 0 and grid[place - 1].near > j:
        grid[place].near = grid[place - 1].near
        place -= 1
    grid[place].near = j


@kernel
def _find_by_radio(index: int, positions: NDArray[Any], radius: float, radio: Any, grid: NDArray[Any]) -> int:
    """List the vehicles within ``radius`` m according to the network, and store their positions as received."""
    start, others, places = radio
    px, py, pz = positions[index, 0], positions[index, 1], positions[index, 2]
    found = 0
    for entry in range(start[index], start[index + 1]):
        x, y, z = places[entry, 0] - px, places[entry, 1] - py, places[entry, 2] - pz
        if x * x + y * y + z * z < radius * radius:
            j = others[entry]
            positions[j, 0], positions[j, 1], positions[j, 2] = places[entry, 0], places[entry, 1], places[entry, 2]
            grid[found].near = j
            found += 1
    return found
