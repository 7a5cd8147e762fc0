"""Kernels on the cells of a floor: shortest paths from a cell, clusters of frontier cells, and viewpoints.

Paths are found by Dijkstra's algorithm (Numerische Mathematik 1, 1959) over the eight neighbours of a cell; frontiers
are those of B. Yamauchi, A frontier-based approach for autonomous exploration, IEEE CIRA 1997.
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel
from xtdrone_planning.paths.grid_search import rise, sink

_NEAR, _NEAR_COST = 0.4, 1.5  # m beyond the clearance within which obstacles add cost, and the maximum cost
_OCCUPIED_FROM = 50  # see floor_map


@kernel
def ways_from(values, distance, clearance, unknown, cell, start, ways, parents):
    """Compute the path costs from a cell to all others.

    Args:
        values: (nx, ny) of the floor.
        distance: (nx, ny) m to the nearest occupied cell.
        clearance: minimum distance to obstacles, m; near the start it may be less while it increases along the path.
        unknown: cost of a metre through unknown cells; 0: they are impassable.
        cell: side, m.
        start: (2,) cell.
        ways: (nx, ny) float32, the result, equivalent metres of free space; infinite where unreachable.
        parents: (nx, ny) int32, the result: index of the preceding cell; -1 at the start and where unreachable.
    """
    nx, ny = values.shape
    ways[:] = np.float32(math.inf)
    parents[:] = -1
    heap, keys = np.empty(8 * nx * ny + 1, np.int32), np.empty(8 * nx * ny + 1, np.float32)
    ways[start[0], start[1]] = 0.0
    heap[0], keys[0] = start[0] * ny + start[1], 0.0
    size = 1
    while size > 0:
        node, key = heap[0], keys[0]
        size -= 1
        sink(heap, keys, size)
        i, j = node // ny, node % ny
        if key > ways[i, j]:
            continue
        here = distance[i, j]
        for a in range(max(0, i - 1), min(nx, i + 2)):
            for b in range(max(0, j - 1), min(ny, j + 2)):
                there = distance[a, b]
                if (a == i and b == j) or values[a, b] >= _OCCUPIED_FROM or (values[a, b] < 0 and unknown <= 0.0):
                    continue
                if there < clearance and not (here < clearance and there >= here):
                    continue
                price = 1.0 + _NEAR_COST * min(1.0, max(0.0, 1.0 - (there - clearance) / _NEAR))
                if values[a, b] < 0:
                    price *= unknown
                cost = np.float32(key + price * cell * math.sqrt(float((a - i) * (a - i) + (b - j) * (b - j))))
                if cost < ways[a, b]:
                    ways[a, b] = cost
                    parents[a, b] = node
                    rise(heap, keys, size, a * ny + b, cost)
                    size += 1


@kernel
def mark_frontiers(values, inside, given_up, frontier):
    """Mark free cells that have an unknown neighbour; both must be inside the area to explore, and the free one not
    given up.

    Args:
        values, inside, given_up: (nx, ny) of the floor.
        frontier: (nx, ny) of bool, the result.
    """
    nx, ny = values.shape
    frontier[:] = False
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            if inside[i, j] and not given_up[i, j] and 0 <= values[i, j] < _OCCUPIED_FROM:
                frontier[i, j] = (
                    (values[i - 1, j] < 0 and inside[i - 1, j])
                    or (values[i + 1, j] < 0 and inside[i + 1, j])
                    or (values[i, j - 1] < 0 and inside[i, j - 1])
                    or (values[i, j + 1] < 0 and inside[i, j + 1])
                )


@kernel
def label_clusters(frontier, reach, labels, queue):
    """Number the clusters of connected frontier cells, each at most ``reach`` cells from its first one.

    Args:
        frontier: (nx, ny) of bool.
        reach: cells along x and y.
        labels: (nx, ny) int32, the result: cluster number from 1; 0: no frontier.
        queue: (nx * ny) int32, scratch array.

    Returns:
        The number of clusters.
    """
    nx, ny = frontier.shape
    labels[:] = 0
    count = 0
    for i in range(nx):
        for j in range(ny):
            if not frontier[i, j] or labels[i, j] > 0:
                continue
            count += 1
            labels[i, j] = count
            queue[0] = i * ny + j
            head, tail = 0, 1
            while head < tail:
                x, y = queue[head] // ny, queue[head] % ny
                head += 1
                for a in range(max(0, x - 1, i - reach), min(nx, x + 2, i + reach + 1)):
                    for b in range(max(0, y - 1, j - reach), min(ny, y + 2, j + reach + 1)):
                        if frontier[a, b] and labels[a, b] == 0:
                            labels[a, b] = count
                            queue[tail] = a * ny + b
                            tail += 1
    return count


@kernel
def nearest_view(values, ways, target, reach, cell):
    """Return the cell from which to view ``target``, (2,) cell: reachable, with line of sight, close, and with a short
    path.

    Args:
        values, ways: of the floor.
        target: (2,) cell.
        reach: maximum distance, cells.
        cell: side, m.

    Returns:
        (i, j), or (-1, -1) without such a cell.
    """
    nx, ny = values.shape
    best, bi, bj = math.inf, -1, -1
    for i in range(max(0, target[0] - reach), min(nx, target[0] + reach + 1)):
        for j in range(max(0, target[1] - reach), min(ny, target[1] + reach + 1)):
            if not math.isfinite(ways[i, j]):
                continue
            away = math.sqrt(float((i - target[0]) ** 2 + (j - target[1]) ** 2))
            cost = ways[i, j] + 2.0 * cell * away
            if away <= reach and cost < best and _in_sight(values, i, j, target[0], target[1]):
                best, bi, bj = cost, i, j
    return bi, bj


@kernel
def _in_sight(values, i, j, a, b):
    """Return whether the line between two cells crosses no occupied cell."""
    steps = 2 * max(abs(a - i), abs(b - j))
    for n in range(1, steps):
        x = math.floor(i + 0.5 + (a - i) * n / steps)
        y = math.floor(j + 0.5 + (b - j) * n / steps)
        if values[x, y] >= _OCCUPIED_FROM:
            return False
    return True
