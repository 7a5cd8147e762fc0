"""Kernels that insert the rays of a measurement into a grid of evidence.

The voxels of a ray are found by the method of J. Amanatides and A. Woo, A fast voxel traversal algorithm for ray
tracing, Eurographics 1987.
"""

from __future__ import annotations

import math

from xtdrone_planning.kernel import kernel

_HIT, _MISS, _LEAST, _MOST = 85, -40, -200, 350  # see voxel_grid
_FREE_TO, _OCCUPIED_FROM = -30, 50


@kernel
def cast_rays(evidence, marks, mark, corner, resolution, origins, ends, hits):
    """Insert rays: +85 where one ends, -40 where one passes, once per voxel and measurement.

    A voxel in which a ray ends is not freed by another ray of the same measurement.

    Args:
        evidence: (nx, ny, nz) int16, changed in place.
        marks: (nx, ny, nz) int32, changed in place: mark of the last measurement that changed each voxel.
        mark: mark of this measurement, 2 more than that of the last one.
        corner: (3,) index of the lowest voxel.
        resolution: side of a voxel, m.
        origins, ends: (n, 3) m in map.
        hits: (n,) whether the ray ends at a surface.
    """
    nx, ny, nz = evidence.shape
    for r in range(len(ends)):
        if hits[r]:
            i = math.floor(ends[r, 0] / resolution) - corner[0]
            j = math.floor(ends[r, 1] / resolution) - corner[1]
            k = math.floor(ends[r, 2] / resolution) - corner[2]
            if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz and marks[i, j, k] <= mark:
                marks[i, j, k] = mark + 1
                evidence[i, j, k] = min(_MOST, evidence[i, j, k] + _HIT)
    for r in range(len(ends)):
        _pass_through(evidence, marks, mark, corner, resolution, origins[r], ends[r])


@kernel
def _pass_through(evidence, marks, mark, corner, resolution, origin, end):
    """Mark the voxels along a ray as free; see ``cast_rays``."""
    nx, ny, nz = evidence.shape
    x, y, z = (
        origin[0] / resolution - corner[0],
        origin[1] / resolution - corner[1],
        origin[2] / resolution - corner[2],
    )
    dx, dy, dz = (end[0] - origin[0]) / resolution, (end[1] - origin[1]) / resolution, (end[2] - origin[2]) / resolution
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    across_x, next_x, step_x = axis_crossing(x, dx, i)
    across_y, next_y, step_y = axis_crossing(y, dy, j)
    across_z, next_z, step_z = axis_crossing(z, dz, k)
    while 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
        if marks[i, j, k] < mark:
            marks[i, j, k] = mark
            evidence[i, j, k] = max(_LEAST, evidence[i, j, k] + _MISS)
        if next_x <= next_y and next_x <= next_z:
            if next_x > 1.0:
                return
            i += step_x
            next_x += across_x
        elif next_y <= next_z:
            if next_y > 1.0:
                return
            j += step_y
            next_y += across_y
        else:
            if next_z > 1.0:
                return
            k += step_z
            next_z += across_z


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
