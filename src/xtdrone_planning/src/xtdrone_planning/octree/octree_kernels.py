"""Kernels that insert the rays of a measurement into blocks of voxels, which are found through a hash table.

A block has 16 x 16 x 16 voxels in Morton order (bits z, y, x of the first halving, then of the second, ...), which is
the order of an octree's children. Ray traversal: J. Amanatides and A. Woo, A fast voxel traversal algorithm for ray
tracing, Eurographics 1987. One measurement changes a voxel once, and a hit takes precedence over rays that pass (A.
Hornung et al., OctoMap, Autonomous Robots 34, 2013, section 4.1).
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel
from xtdrone_planning.mapping.ray_casting import axis_crossing

SIDE = 16
VOXELS = SIDE**3
HALF = 1 << 15
"""Voxels on each side of the origin, along each axis: an octree of 16 levels."""
_SPREAD = np.array([sum(((n >> bit) & 1) << (3 * bit) for bit in range(4)) for n in range(SIDE)], np.int64)

UNKNOWN = 0
OFFSET = 1000
"""A voxel holds its log-odds in hundredths plus this, or ``UNKNOWN``."""

_PASSED, _HIT = 1, 2  # of a voxel in the current measurement


@kernel
def find_block(table, keys, key):
    """Return the index of a block, or -1 - its slot in the table if there is none.

    Args:
        table: (2^m,) int64, index of a block or -1.
        keys: (n,) int64, key of each block: x + 4096 y + 4096^2 z, in blocks.
        key: Key of the block.
    """
    mask = len(table) - 1
    place = (key ^ (key >> 12) * 40503 ^ (key >> 24) * 2654435761) & mask
    while table[place] >= 0:
        if keys[table[place]] == key:
            return table[place]
        place = (place + 1) & mask
    return -1 - place


@kernel
def _block(table, keys, counts, key):
    """Return the index of a block, which is added if there is memory; otherwise count it and return -1."""
    found = find_block(table, keys, key)
    if found >= 0:
        return found
    if counts[0] >= len(keys):
        counts[1] += 1
        return -1
    number = counts[0]
    counts[0] += 1
    keys[number] = key
    table[-1 - found] = number
    return number


@kernel
def enter_rays(table, keys, counts, voxels, seen, touched, touched_at, change, resolution, origins, ends, hits):
    """Insert the rays of a measurement.

    Args:
        table, keys: see ``find_block``; changed in place.
        counts: (2,) int64: blocks in use; visits of blocks for which there was no memory. Changed in place.
        voxels: (n, 4096) uint16: ``OFFSET`` and log-odds in hundredths. Changed in place.
        seen: (n, 4096) uint8, zeros before and after.
        touched: (n,) int64, scratch array for block indices.
        touched_at: (n,) bool, False before and after.
        change: hit, miss, least, most, hundredths.
        resolution: side of a voxel, m.
        origins, ends: (m, 3) m in map.
        hits: (m,) whether the ray ends at a surface.
    """
    count = 0
    carves = np.ones(len(ends), np.bool_)
    for r in range(len(ends)):
        if hits[r]:
            i = math.floor(ends[r, 0] / resolution) + HALF
            j = math.floor(ends[r, 1] / resolution) + HALF
            k = math.floor(ends[r, 2] / resolution) + HALF
            if not _is_inside(i, j, k):
                continue
            block = _block(table, keys, counts, (i >> 4) + ((j >> 4) << 12) + ((k >> 4) << 24))
            if block < 0:
                continue
            if not touched_at[block]:
                touched_at[block], touched[count] = True, block
                count += 1
            voxel = _SPREAD[i & 15] | _SPREAD[j & 15] << 1 | _SPREAD[k & 15] << 2
            carves[r] = seen[block, voxel] != _HIT  # a second ray to the same voxel traverses nearly the same voxels
            seen[block, voxel] = _HIT
    for r in range(len(ends)):
        if carves[r]:
            count = _pass_through(
                table, keys, counts, seen, touched, touched_at, count, resolution, origins[r], ends[r]
            )
    _apply(voxels, seen, touched, touched_at, count, change)


@kernel
def _is_inside(i, j, k):
    """Return whether a voxel is within the octree."""
    most = 2 * HALF
    return 0 <= i < most and 0 <= j < most and 0 <= k < most


@kernel
def _pass_through(table, keys, counts, seen, touched, touched_at, count, resolution, origin, end):
    """Mark the voxels of a ray as free; return the number of touched blocks. See ``enter_rays``."""
    x, y, z = origin[0] / resolution, origin[1] / resolution, origin[2] / resolution
    dx, dy, dz = end[0] / resolution - x, end[1] / resolution - y, end[2] / resolution - z
    if not math.isfinite(x + y + z + dx + dy + dz):
        return count
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    across_x, next_x, step_x = axis_crossing(x, dx, i)
    across_y, next_y, step_y = axis_crossing(y, dy, j)
    across_z, next_z, step_z = axis_crossing(z, dz, k)
    i, j, k = i + HALF, j + HALF, k + HALF
    last_key, block = -1, -1
    while _is_inside(i, j, k):
        key = (i >> 4) + ((j >> 4) << 12) + ((k >> 4) << 24)
        if key != last_key:
            last_key, block = key, _block(table, keys, counts, key)
            if block >= 0 and not touched_at[block]:
                touched_at[block], touched[count] = True, block
                count += 1
        if block >= 0:
            voxel = _SPREAD[i & 15] | _SPREAD[j & 15] << 1 | _SPREAD[k & 15] << 2
            seen[block, voxel] |= _PASSED
        if next_x <= next_y and next_x <= next_z:
            if next_x > 1.0:
                return count
            i += step_x
            next_x += across_x
        elif next_y <= next_z:
            if next_y > 1.0:
                return count
            j += step_y
            next_y += across_y
        else:
            if next_z > 1.0:
                return count
            k += step_z
            next_z += across_z
    return count


@kernel
def _apply(voxels, seen, touched, touched_at, count, change):
    """Update the voxels seen by the measurement, and clear its marks."""
    hit, miss, least, most = change[0], change[1], change[2] + OFFSET, change[3] + OFFSET
    for n in range(count):
        block = touched[n]
        touched_at[block] = False
        for v in range(VOXELS):
            state = seen[block, v]
            if state:
                seen[block, v] = 0
                value = voxels[block, v]
                value = (OFFSET if value == UNKNOWN else value) + (hit if state >= _HIT else miss)
                voxels[block, v] = min(most, max(least, value))
