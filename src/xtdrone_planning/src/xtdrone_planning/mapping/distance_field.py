"""Kernels that compute the distance to the nearest obstacle.

The transform is that of P. Felzenszwalb and D. Huttenlocher, Distance transforms of sampled functions, Theory of
Computing 8, 2012: axis by axis, each pass the lower envelope of parabolas.
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel


@kernel
def distance_field(evidence, occupied_from, resolution, farthest, distance):
    """Compute the Euclidean distances to the nearest occupied voxel.

    Args:
        evidence: (nx, ny, nz) int16.
        occupied_from: minimum evidence of an occupied voxel.
        resolution: side of a voxel, m.
        farthest: distances are limited to this, m.
        distance: (nx, ny, nz) float32, m between centres of voxels; the result.
    """
    nx, ny, nz = evidence.shape
    reach = np.float32(math.ceil(farthest / resolution) + 1.0)
    most = reach * reach
    for i in range(nx):
        for j in range(ny):
            _along_column(evidence[i, j], occupied_from, reach, distance[i, j])
    size = max(nx, ny)
    row, places, bounds = np.empty(size, np.float32), np.empty(size, np.int32), np.empty(size + 1, np.float32)
    for i in range(nx):
        for k in range(nz):
            _envelope(distance[i, :, k], most, row, places, bounds)
    limit = np.float32(farthest)
    for j in range(ny):
        for k in range(nz):
            _envelope(distance[:, j, k], most, row, places, bounds)
            for i in range(nx):
                distance[i, j, k] = min(limit, np.float32(math.sqrt(distance[i, j, k])) * np.float32(resolution))


@kernel
def _along_column(column, occupied_from, reach, squares):
    """Write the squared distance, in voxels, to the nearest occupied voxel of a column, by one pass up and one down."""
    away = reach
    for k in range(len(column)):
        away = np.float32(0.0) if column[k] >= occupied_from else min(reach, away + np.float32(1.0))
        squares[k] = away
    away = reach
    for k in range(len(column) - 1, -1, -1):
        away = np.float32(0.0) if column[k] >= occupied_from else min(reach, away + np.float32(1.0))
        nearest = min(away, squares[k])
        squares[k] = nearest * nearest


@kernel
def _envelope(line, most, row, places, bounds):
    """Replace the squared distances along a line by the minimum over the whole line.

    Args:
        line: (n,) squared distances, voxels, changed in place.
        most: squared distance that stands for no obstacle within reach; its parabolas are skipped.
        row, places, bounds: scratch space of at least n, n and n + 1.
    """
    n = len(line)
    last = -1
    for q in range(n):
        height = line[q]
        row[q] = height
        if height >= most:
            continue
        cut = np.float32(-math.inf)
        while last >= 0:
            p = places[last]
            cut = np.float32(((height + q * q) - (row[p] + p * p)) / (2.0 * (q - p)))
            if cut > bounds[last]:
                break
            last -= 1
        last += 1
        places[last] = q
        bounds[last] = cut if last > 0 else np.float32(-math.inf)
        bounds[last + 1] = np.float32(math.inf)
    if last < 0:
        return
    at = 0
    for q in range(n):
        while bounds[at + 1] < q:
            at += 1
        p = places[at]
        line[q] = min(most, np.float32((q - p) * (q - p)) + row[p])
