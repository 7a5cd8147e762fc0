"""Kernels that find vehicles near each other: by what they know of others, and by where they are.

Points are sorted into cubic cells, so that the work is of the order of the number of near vehicles.
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_control.network.channel import NEVER, sample, within
from xtdrone_coordination.kernel import kernel


@kernel
def near(air, radius):
    """Find the vehicles known to be less than ``radius`` from each vehicle.

    Candidates are those near its current position in any stored turn.

    Returns:
        First index of each vehicle's entries (N + 1,), the numbers of the others, ascending, and their positions as
        known to this vehicle (E, 3), m.
    """
    now = air.turn[0]
    rows = air.sent.shape[0]
    points = air.position[now % rows]
    count = len(points)
    first = max(0, now - rows + 1)
    reach = radius + (air.travel[now % rows] - air.travel[first % rows]) + 1e-6
    least, greatest = bounding_boxes(air)
    low, inverse, shape, begin, order = cells(points, reach)
    start = np.zeros(count + 1, dtype=np.int64)
    found = np.empty(count, dtype=np.int64)
    others = np.empty(16 * count, dtype=np.int64)
    places = np.empty((16 * count, 3))
    velocity = np.empty(3)
    n = 0
    for i in range(count):
        if air.own[i] >= max(air.since[i], 0):
            candidates = around(points[i], low, inverse, shape, begin, order, found)
            kept = 0
            for k in range(candidates):
                if found[k] != i and beside(points[i], least[found[k]], greatest[found[k]], radius * radius):
                    found[kept] = found[k]
                    kept += 1
            found[:kept].sort()
            for k in range(kept):
                if n == len(others):
                    others = np.concatenate((others, np.empty_like(others)))
                    places = np.concatenate((places, np.empty_like(places)))
                if sample(air, i, found[k], places[n], velocity) == NEVER:
                    continue
                x, y, z = places[n, 0] - points[i, 0], places[n, 1] - points[i, 1], places[n, 2] - points[i, 2]
                if x * x + y * y + z * z < radius * radius:
                    others[n] = found[k]
                    n += 1
        start[i + 1] = n
    return start, others[:n], places[:n]


@kernel
def bounding_boxes(air):
    """Return the corners of each vehicle's bounding box over all stored turns, (N, 3) each."""
    now = air.turn[0]
    rows = air.sent.shape[0]
    low = air.position[now % rows].copy()
    high = low.copy()
    for row in range(min(rows, now + 1)):
        for j in range(len(low)):
            for axis in range(3):
                x = air.position[row, j, axis]
                if x < low[j, axis]:
                    low[j, axis] = x
                elif x > high[j, axis]:
                    high[j, axis] = x
    return low, high


@kernel
def beside(point, low, high, square):
    """Return whether the squared distance of a point to a box is at most ``square``."""
    total = 0.0
    for axis in range(3):
        d = max(low[axis] - point[axis], 0.0, point[axis] - high[axis])
        total += d * d
    return total <= square


@kernel
def crowds(points, reach, crowd):
    """Store for each vehicle the maximum number of vehicles within ``reach`` of any vehicle within its reach.

    Each vehicle counts itself; one of unknown position gets 1.
    """
    count = len(points)
    heard = np.ones(count)
    if math.isinf(reach):
        known = 0
        for i in range(count):
            known += math.isfinite(points[i, 0] + points[i, 1] + points[i, 2])
        crowd[:] = max(known, 1)
        return
    low, inverse, shape, start, order = cells(points, reach)
    found = np.empty(count, dtype=np.int64)
    square = reach * reach
    for i in order:
        n = around(points[i], low, inverse, shape, start, order, found)
        heard[i] = 0
        for k in range(n):
            heard[i] += within(points, i, found[k], square)
    crowd[:] = heard
    for i in order:
        n = around(points[i], low, inverse, shape, start, order, found)
        for k in range(n):
            if heard[found[k]] > crowd[i] and within(points, i, found[k], square):
                crowd[i] = heard[found[k]]


@kernel
def reached(listeners, speakers, points, square, reach):
    """Mark in ``reach`` the vehicles with a path from the leader along links within range.

    Args:
        listeners: receiver of each link.
        speakers: sender of each link.
        points: positions, shape (N, 3), m.
        square: of the range, m^2.
        reach: all False, shape (N,); written.
    """
    count = len(points)
    start = np.zeros(count + 1, dtype=np.int64)
    for k in range(len(speakers)):
        start[speakers[k] + 1] += 1
    for j in range(count):
        start[j + 1] += start[j]
    order = np.empty(len(speakers), dtype=np.int64)
    filled = start[:-1].copy()
    for k in range(len(speakers)):
        order[filled[speakers[k]]] = listeners[k]
        filled[speakers[k]] += 1
    waiting = np.empty(count, dtype=np.int64)
    waiting[0] = 0
    reach[0] = True
    n = 1
    while n > 0:
        n -= 1
        j = waiting[n]
        for k in range(start[j], start[j + 1]):
            i = order[k]
            if not reach[i] and within(points, i, j, square):
                reach[i] = True
                waiting[n] = i
                n += 1


@kernel
def cells(points, size):
    """Sort points into cubic cells with an edge of at least ``size``, without those that are not finite.

    Returns:
        The lowest corner (3,), the inverse of the edge, the numbers of cells (3,), the first index of each cell in the
        last array (cells + 1,), and the numbers of the points, cell by cell, ascending in each.
    """
    count = len(points)
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for i in range(count):
        if math.isfinite(points[i, 0] + points[i, 1] + points[i, 2]):
            for axis in range(3):
                low[axis] = min(low[axis], points[i, axis])
                high[axis] = max(high[axis], points[i, axis])
    shape = np.ones(3, dtype=np.int64)
    edge = size
    while math.isfinite(edge) and low[0] <= high[0]:
        total = 1.0
        for axis in range(3):
            total *= math.floor((high[axis] - low[axis]) / edge) + 1.0
        if total <= 4.0 * count + 64.0:
            for axis in range(3):
                shape[axis] = math.floor((high[axis] - low[axis]) / edge) + 1
            break
        edge *= 1.26  # twice the volume: bounds the number of cells of a widely spread swarm
    inverse = 1.0 / edge
    cell = np.full(count, -1, dtype=np.int64)
    start = np.zeros(shape[0] * shape[1] * shape[2] + 1, dtype=np.int64)
    for i in range(count):
        if math.isfinite(points[i, 0] + points[i, 1] + points[i, 2]):
            cell[i] = cell_of(points[i], low, inverse, shape)
            start[cell[i] + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]
    order = np.empty(start[-1], dtype=np.int64)
    filled = start[:-1].copy()
    for i in range(count):
        if cell[i] >= 0:
            order[filled[cell[i]]] = i
            filled[cell[i]] += 1
    return low, inverse, shape, start, order


@kernel
def cell_of(point, low, inverse, shape):
    """Return the number of the cell of a finite point, not below ``low``."""
    x = max(0, min(int((point[0] - low[0]) * inverse), shape[0] - 1))
    y = max(0, min(int((point[1] - low[1]) * inverse), shape[1] - 1))
    z = max(0, min(int((point[2] - low[2]) * inverse), shape[2] - 1))
    return (x * shape[1] + y) * shape[2] + z


@kernel
def around(point, low, inverse, shape, start, order, found):
    """Store the numbers of the points in a point's cell and the cells next to it in ``found``; return their number."""
    n = 0
    x = max(0, min(int((point[0] - low[0]) * inverse), shape[0] - 1))
    y = max(0, min(int((point[1] - low[1]) * inverse), shape[1] - 1))
    z = max(0, min(int((point[2] - low[2]) * inverse), shape[2] - 1))
    for cx in range(max(0, x - 1), min(shape[0], x + 2)):
        for cy in range(max(0, y - 1), min(shape[1], y + 2)):
            for cz in range(max(0, z - 1), min(shape[2], z + 2)):
                c = (cx * shape[1] + cy) * shape[2] + cz
                for k in range(start[c], start[c + 1]):
                    found[n] = order[k]
                    n += 1
    return n
