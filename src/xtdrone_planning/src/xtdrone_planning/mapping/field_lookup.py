"""Kernels that interpolate a map between the centres of its voxels."""

from __future__ import annotations

import math

from xtdrone_planning.kernel import kernel

_FREE_TO, _OCCUPIED_FROM = -30, 50  # see voxel_grid


@kernel
def distance_at(distance, corner, resolution, x, y, z):
    """Return the distance to the nearest obstacle and its gradient at a point, by trilinear interpolation.

    Args:
        distance: (nx, ny, nz) m, of the centres of voxels.
        corner: (3,) index of the lowest voxel.
        resolution: side of a voxel, m.
        x, y, z: m in map.

    Returns:
        (distance, gradient x, y, z), m and without unit. A point outside gets the value of the nearest voxel inside,
        and no gradient along the axes on which it is outside.
    """
    nx, ny, nz = distance.shape
    a, i, slope_x = _cell(x / resolution - corner[0] - 0.5, nx)
    b, j, slope_y = _cell(y / resolution - corner[1] - 0.5, ny)
    c, k, slope_z = _cell(z / resolution - corner[2] - 0.5, nz)
    d000, d001 = distance[i, j, k], distance[i, j, k + 1]
    d010, d011 = distance[i, j + 1, k], distance[i, j + 1, k + 1]
    d100, d101 = distance[i + 1, j, k], distance[i + 1, j, k + 1]
    d110, d111 = distance[i + 1, j + 1, k], distance[i + 1, j + 1, k + 1]
    d00, d01 = d000 + a * (d100 - d000), d001 + a * (d101 - d001)
    d10, d11 = d010 + a * (d110 - d010), d011 + a * (d111 - d011)
    d0, d1 = d00 + b * (d10 - d00), d01 + b * (d11 - d01)
    value = d0 + c * (d1 - d0)
    gz = slope_z * (d1 - d0)
    gy = slope_y * ((1.0 - c) * (d10 - d00) + c * (d11 - d01))
    low = (1.0 - b) * (d100 - d000) + b * (d110 - d010)
    high = (1.0 - b) * (d101 - d001) + b * (d111 - d011)
    gx = slope_x * ((1.0 - c) * low + c * high)
    return value, gx / resolution, gy / resolution, gz / resolution


@kernel
def _cell(place, count):
    """Return for one axis the fraction between two voxels, the index of the lower one, and 1 inside or 0 outside."""
    if place <= 0.0:
        return 0.0, 0, 0.0
    if place >= count - 1.0:
        return 1.0, count - 2, 0.0
    lower = math.floor(place)
    return place - lower, lower, 1.0


@kernel
def is_seen(evidence, corner, resolution, x, y, z, radius):
    """Return whether a horizontal disc around a point was observed to be free.

    There are gaps between the planes of a lidar, so a voxel counts as seen if it or the one above or below is free; a
    disc is enough because the vehicle is flat.

    Args:
        evidence: (nx, ny, nz) int16.
        corner: (3,) index of the lowest voxel.
        resolution: side of a voxel, m.
        x, y, z: the disc's centre, m in map.
        radius: Radius of the disc, m.
    """
    nx, ny, nz = evidence.shape
    ci, cj = x / resolution - corner[0], y / resolution - corner[1]
    k = math.floor(z / resolution) - corner[2]
    reach = radius / resolution
    if not (ci - reach >= 0 and ci + reach < nx and cj - reach >= 0 and cj + reach < ny and 0 <= k < nz):
        return False
    for i in range(math.floor(ci - reach), math.floor(ci + reach) + 1):
        for j in range(math.floor(cj - reach), math.floor(cj + reach) + 1):
            u, v = i + 0.5 - ci, j + 0.5 - cj
            if u * u + v * v > reach * reach:
                continue
            if evidence[i, j, k] > _FREE_TO:
                if evidence[i, j, k] >= _OCCUPIED_FROM:
                    return False
                below = k > 0 and evidence[i, j, k - 1] <= _FREE_TO
                above = k < nz - 1 and evidence[i, j, k + 1] <= _FREE_TO
                if not (below or above):
                    return False
    return True
