"""Kernels that insert the rays of a measurement into a grid of evidence.

The voxels of a ray are found by the method of J. Amanatides and A. Woo, A fast voxel traversal algorithm for ray
tracing, Eurographics 1987. Several rays are followed side by side, without branches, so that the processor's vector
instructions take a step of four or eight of them at once.
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel

_HIT, _MISS, _LEAST, _MOST = np.int16(85), np.int16(-40), np.int16(-200), np.int16(350)  # see voxel_grid
_FREE_TO, _OCCUPIED_FROM = -30, 50

_PASSED, _ENDED = 1, 2
_RAYS = 32
"""Rays that are followed side by side.

Of each, ``way`` has as parts of the ray's length: where it enters the next voxel along x, y, z, what a voxel is across
along x, y, z, and the last part in the box; then, in voxels, where it begins and its length, x, y, z each. ``cells``
has the number of its voxel, and what this changes by along x, y, z.
"""
_NEXT, _ACROSS, _LAST, _PLACE, _LENGTH, _WAY = 0, 3 * _RAYS, 6 * _RAYS, 7 * _RAYS, 10 * _RAYS, 13 * _RAYS
_WITHIN = 1.0 - 1e-12  # so that no ray is followed out of the box by rounding


@kernel
def cast_rays(evidence, touched, corner, resolution, origins, ends, hits):
    """Enter rays: +85 where one ends, -40 where one passes, once for each voxel and measurement.

    A voxel in which a ray ends is not freed by another ray of the same measurement. The order of rays does not matter.

    Args:
        evidence: (nx, ny, nz) int16, contiguous, changed in place.
        touched: (nx ny nz + 1,) uint8, zeros before and after, the last one excepted.
        corner: (3,) number of the lowest voxel.
        resolution: side of a voxel, m.
        origins, ends: (n, 3) m in map, finite. A ray that begins outside frees nothing.
        hits: (n,) whether the ray ends at something.
    """
    nx, ny, nz = evidence.shape
    count = len(ends)
    way, cells = np.empty(_WAY), np.empty(4 * _RAYS, np.int64)
    low, high = nx, -1  # layers along x that rays may touch
    for first in range(0, count, _RAYS):
        for ray in range(_RAYS):
            r = min(first + ray, count - 1)
            for c in range(3):
                way[_PLACE + c * _RAYS + ray] = origins[r, c] / resolution - corner[c]
                way[_LENGTH + c * _RAYS + ray] = (ends[r, c] - origins[r, c]) / resolution
            begin, end = way[_PLACE + ray], way[_PLACE + ray] + way[_LENGTH + ray]
            low = int(min(low, max(0.0, min(begin, end) - 1.0)))
            high = int(max(high, min(nx - 1.0, max(begin, end) + 1.0)))
        _follow(touched, way, cells, nx, ny, nz)
    for r in range(count):
        if hits[r]:
            i = math.floor(ends[r, 0] / resolution) - corner[0]
            j = math.floor(ends[r, 1] / resolution) - corner[1]
            k = math.floor(ends[r, 2] / resolution) - corner[2]
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                touched[(i * ny + j) * nz + k] = _ENDED
    if low <= high:
        _enter(touched[low * ny * nz : (high + 1) * ny * nz], evidence[low : high + 1].reshape(-1))


@kernel
def _follow(touched, way, cells, nx, ny, nz):
    """Mark the voxels of some rays; see ``_RAYS``."""
    for ray in range(_RAYS):
        way[_LAST + ray] = 1.0
        cells[ray] = 0
    _begin(way, cells, 0, nx, ny * nz)
    _begin(way, cells, _RAYS, ny, nz)
    _begin(way, cells, 2 * _RAYS, nz, 1)
    nowhere = nx * ny * nz
    for ray in range(_RAYS):
        if way[_LAST + ray] < 0.0:
            cells[ray] = nowhere
    going = 1
    while going:
        for ray in range(_RAYS):
            touched[np.uint64(cells[ray])] = _PASSED
        going = _advance(way, cells, nowhere)


@kernel
def _begin(way, cells, axis, count, stride):
    """Prepare ``way`` and ``cells`` for one axis.

    Args:
        way, cells: see ``_RAYS``. The last part is negative for a ray that begins outside.
        axis: 0, ``_RAYS`` or twice that.
        count: voxels along it.
        stride: what it changes the number of a voxel by.
    """
    for ray in range(_RAYS):
        place, length = way[_PLACE + axis + ray], way[_LENGTH + axis + ray]
        cell = np.floor(place)
        across = abs(1.0 / length)
        entered = ((cell + 1.0 if length > 0.0 else cell) - place) / length
        entered = entered if length != 0.0 else math.inf
        further = count - 1.0 - cell if length > 0.0 else cell  # voxels before the box ends
        leaves = _WITHIN * (entered + further * across) if length != 0.0 else math.inf
        last = way[_LAST + ray]
        last = leaves if leaves < last else last
        way[_LAST + ray] = last if (cell >= 0.0) & (cell < count) & (across > 0.0) else -1.0
        way[_NEXT + axis + ray], way[_ACROSS + axis + ray] = entered, across
    for ray in range(_RAYS):
        cells[ray] += math.floor(way[_PLACE + axis + ray]) * stride
        cells[_RAYS + axis + ray] = stride if way[_LENGTH + axis + ray] > 0.0 else -stride


@kernel
def _advance(way, cells, nowhere):
    """Move rays on to their next voxel, finished ones to ``nowhere``; return the number of unfinished rays."""
    going = 0
    for ray in range(_RAYS):
        x, y, z = way[ray], way[_RAYS + ray], way[2 * _RAYS + ray]
        across_x, across_y, across_z = way[3 * _RAYS + ray], way[4 * _RAYS + ray], way[5 * _RAYS + ray]
        at, step_x, step_y, step_z = cells[ray], cells[_RAYS + ray], cells[2 * _RAYS + ray], cells[3 * _RAYS + ray]
        yz = y if y <= z else z
        is_x, is_y = x <= yz, y <= z
        entered = x if is_x else yz
        across_y = across_y if is_y else 0.0
        across_z = 0.0 if is_y else across_z
        way[ray] = x + (across_x if is_x else 0.0)
        way[_RAYS + ray] = y + (0.0 if is_x else across_y)
        way[2 * _RAYS + ray] = z + (0.0 if is_x else across_z)
        step = step_y if is_y else step_z
        step = step_x if is_x else step
        goes = entered <= way[_LAST + ray]
        cells[ray] = at + step if goes else nowhere
        going += 1 if goes else 0
    return going


@kernel
def _enter(touched, evidence):
    """Change the evidence (n,) of the voxels that were passed or ended in, and forget these."""
    for n in range(len(evidence)):
        was, how = evidence[n], touched[n]
        missed, hit = max(_LEAST, np.int16(was + _MISS)), min(_MOST, np.int16(was + _HIT))
        now = missed if how == _PASSED else was
        evidence[n] = hit if how == _ENDED else now
        touched[n] = 0


@kernel
def axis_crossing(place, length, cell):
    """Return for one axis the fraction of the ray per voxel, the fraction up to the next voxel, and the step, 1 or
    -1."""
    if length > 0.0:
        return 1.0 / length, (cell + 1.0 - place) / length, 1
    if length < 0.0:
        return -1.0 / length, (cell - place) / length, -1
    return math.inf, math.inf, 0


@kernel
def free_sphere(evidence, corner, resolution, centre, radius):
    """Mark unknown voxels as free whose centre is within ``radius`` m of ``centre``, (3,) m in map."""
    nx, ny, nz = evidence.shape
    reach = math.ceil(radius / resolution)
    ci = math.floor(centre[0] / resolution) - corner[0]
    cj = math.floor(centre[1] / resolution) - corner[1]
    ck = math.floor(centre[2] / resolution) - corner[2]
    for i in range(max(0, ci - reach), min(nx, ci + reach + 1)):
        for j in range(max(0, cj - reach), min(ny, cj + reach + 1)):
            for k in range(max(0, ck - reach), min(nz, ck + reach + 1)):
                x = (i + corner[0] + 0.5) * resolution - centre[0]
                y = (j + corner[1] + 0.5) * resolution - centre[1]
                z = (k + corner[2] + 0.5) * resolution - centre[2]
                if x * x + y * y + z * z <= radius * radius and _FREE_TO < evidence[i, j, k] < _OCCUPIED_FROM:
                    evidence[i, j, k] = _MISS
