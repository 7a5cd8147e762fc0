"""Kernels of the path search on the local grid: A* (P. Hart, N. Nilsson, B. Raphael, IEEE Transactions on Systems
Science and Cybernetics 4, 1968) over the 26 neighbours of a voxel.

The heuristic is weighted by slightly more than 1 (I. Pohl, 1970), which expands far fewer voxels; a path is at most
longer than the shortest by this factor.
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel

REACHED, BLOCKED, UNDECIDED = 1, 0, 2
"""Outcomes: a path was found; there is none; the search ended before either was known."""

_FREE_TO = -30  # see voxel_grid
_WEIGHT = 1.2  # of the heuristic
STEEP = 2.0
"""Cost of a metre up or down, in horizontal metres: lidars and cameras see best straight ahead."""
_UNKNOWN = 1.0  # additional cost of a metre through unknown space
_NEAR, _NEAR_COST = 0.4, 1.5  # m beyond the clearance within which obstacles add cost, and the maximum cost


@kernel
def search(
    distance, evidence, clearance, start, goal, lowest, highest, most, costs, parents, stamps, stamp, heap, keys
):
    """Search for a path from a voxel to a goal; if the goal is outside, to where the path leaves the grid.

    Args:
        distance: (nx, ny, nz) to the nearest obstacle, m.
        evidence: (nx, ny, nz); unknown voxels cost more.
        clearance: minimum distance to obstacles along the path; near the start it may be less while it increases.
        start: (3,) voxel.
        goal: (3,) of float, in voxels of the grid.
        lowest, highest: layers that may be used.
        most: maximum number of expanded voxels.
        costs, parents, stamps: (nx * ny * nz) scratch space of float32, int32 and int32.
        stamp: id of this search; must not be in ``stamps``.
        heap, keys: scratch space of equal size, int32 and float32.

    Returns:
        (outcome, voxels): the voxels (n, 3) from the start; if the goal is not reached, up to the one nearest to it.
    """
    nx, ny, nz = distance.shape
    gi, gj, gk = math.floor(goal[0]), math.floor(goal[1]), math.floor(goal[2])
    outside = not (0 <= gi < nx and 0 <= gj < ny)
    gk = min(max(gk, lowest), highest)
    node = (start[0] * ny + start[1]) * nz + start[2]
    costs[node], parents[node], stamps[node] = 0.0, -1, stamp
    heap[0], keys[0] = node, 0.0
    size, opened, outcome = 1, 0, BLOCKED
    nearest, nearest_way = node, math.inf
    while size > 0:
        node = heap[0]
        key = keys[0]
        size -= 1
        sink(heap, keys, size)
        i, j, k = node // (ny * nz), node // nz % ny, node % nz
        way = _way(i - goal[0], j - goal[1], k - goal[2])
        if key > costs[node] + _WEIGHT * way + 1e-3:
            continue  # a better path to this voxel was found after it was queued
        if way < nearest_way:
            nearest, nearest_way = node, way
        if (i == gi and j == gj and k == gk) or (outside and (i == 0 or j == 0 or i == nx - 1 or j == ny - 1)):
            nearest, outcome = node, REACHED
            break
        opened += 1
        if opened > most or size + 26 > len(heap):
            outcome = UNDECIDED
            break
        here = distance[i, j, k]
        for di in range(-1, 2):
            for dj in range(-1, 2):
                for dk in range(-1, 2):
                    a, b, c = i + di, j + dj, k + dk
                    if (di == 0 and dj == 0 and dk == 0) or not (
                        0 <= a < nx and 0 <= b < ny and lowest <= c <= highest
                    ):
                        continue
                    there = distance[a, b, c]
                    if not _passable(here, there, clearance):
                        continue
                    other = (a * ny + b) * nz + c
                    near = max(0.0, 1.0 - max(0.0, there - clearance) / _NEAR)
                    price = 1.0 + _NEAR_COST * near + (_UNKNOWN if evidence[a, b, c] > _FREE_TO else 0.0)
                    cost = np.float32(costs[node] + price * _way(di, dj, dk))
                    if stamps[other] == stamp and cost >= costs[other]:
                        continue
                    costs[other], parents[other], stamps[other] = cost, node, stamp
                    rise(heap, keys, size, other, cost + _WEIGHT * _way(a - goal[0], b - goal[1], c - goal[2]))
                    size += 1
    return outcome, _voxels(parents, nearest, ny, nz)


@kernel
def mark_reachable(distance, clearance, start, reached, queue):
    """Mark the voxels to which ``search`` finds a path if all layers may be used.

    Args:
        distance, clearance, start: see ``search``.
        reached: (nx, ny, nz) of bool, all False; the result.
        queue: (nx * ny * nz) int32, scratch array.
    """
    nx, ny, nz = distance.shape
    reached[start[0], start[1], start[2]] = True
    queue[0] = (start[0] * ny + start[1]) * nz + start[2]
    head, tail = 0, 1
    while head < tail:
        node = queue[head]
        head += 1
        i, j, k = node // (ny * nz), node // nz % ny, node % nz
        here = distance[i, j, k]
        for a in range(max(0, i - 1), min(nx, i + 2)):
            for b in range(max(0, j - 1), min(ny, j + 2)):
                for c in range(max(0, k - 1), min(nz, k + 2)):
                    if not reached[a, b, c] and _passable(here, distance[a, b, c], clearance):
                        reached[a, b, c] = True
                        queue[tail] = (a * ny + b) * nz + c
                        tail += 1


@kernel
def _passable(here, there, clearance):
    """Return whether a path may lead to a neighbour, from the distances of both to obstacles: away from one that is
    too near, or where none is."""
    return there >= clearance or (here < clearance and there >= here and there > 0.0)


@kernel
def _way(di, dj, dk):
    """Return the cost of a straight path in free space, in voxels."""
    return math.sqrt(di * di + dj * dj + STEEP * STEEP * dk * dk)


@kernel
def _voxels(parents, node, ny, nz):
    """Return the voxels (n, 3) that lead to ``node``, in order."""
    count, at = 0, node
    while at >= 0:
        count += 1
        at = parents[at]
    voxels = np.empty((count, 3), np.int64)
    at = node
    for n in range(count - 1, -1, -1):
        voxels[n, 0], voxels[n, 1], voxels[n, 2] = at // (ny * nz), at // nz % ny, at % nz
        at = parents[at]
    return voxels


@kernel
def rise(heap, keys, place, node, key):
    """Insert a node at the end, ``place``, of the binary heap."""
    while place > 0:
        above = (place - 1) // 2
        if keys[above] <= key:
            break
        heap[place], keys[place] = heap[above], keys[above]
        place = above
    heap[place], keys[place] = node, key


@kernel
def sink(heap, keys, size):
    """Remove the first node of a heap that had ``size`` + 1."""
    node, key, place = heap[size], keys[size], 0
    while True:
        below = 2 * place + 1
        if below >= size:
            break
        if below + 1 < size and keys[below + 1] < keys[below]:
            below += 1
        if keys[below] >= key:
            break
        heap[place], keys[place] = heap[below], keys[below]
        place = below
    heap[place], keys[place] = node, key
