"""Closest velocity to the desired one that lies in every half-space and in a ball.

The half-spaces ``normals[k] . v >= offsets[k]`` enter one by one, as in Seidel's incremental linear programming (Seidel
1991; for collision avoidance: van den Berg, Guy, Lin, Manocha 2011, in two dimensions). While the next one is
satisfied, the solution is unchanged. Otherwise the new solution lies on its plane, and the same problem is solved there
in one dimension less. The result is exact, and depends only on the order of the half-spaces.
"""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel

_TINY = 1e-9
_BISECTIONS = 30


@kernel
def nearest(normals, offsets, weights, count, wanted, radius, result):
    """Store the point nearest to ``wanted`` in the intersection of all half-spaces and the ball around zero.

    If the intersection is empty, the half-spaces are moved outwards, in proportion to their weights, by the smallest
    distances that make it non-empty.

    Args:
        normals: unit vectors, shape (K, 3), K at least ``count``.
        offsets: shape (K,).
        weights: Weights by which the half-spaces are moved, shape (K,), above 0.
        count: number of half-spaces.
        wanted: shape (3,).
        radius: Radius of the ball, above 0.
        result: shape (3,); written.

    Returns:
        The distance by which a half-space of weight 1 was moved; 0 if none was moved.
    """
    if _in_space(normals, offsets, weights, count, 0.0, wanted, radius, result):
        return 0.0
    low, high = 0.0, 0.0
    for k in range(count):
        high = max(high, offsets[k] / weights[k])  # with this, zero itself is allowed
    high += _TINY
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if _in_space(normals, offsets, weights, count, middle, wanted, radius, result):
            high = middle
        else:
            low = middle
    _in_space(normals, offsets, weights, count, high, wanted, radius, result)
    return high


@kernel
def _in_space(normals, offsets, weights, count, moved, wanted, radius, result):
    """Solve in three dimensions; return whether there is a solution. All offsets are lowered by ``moved``."""
    length = math.sqrt(wanted[0] ** 2 + wanted[1] ** 2 + wanted[2] ** 2)
    share = radius / length if length > radius else 1.0
    for axis in range(3):
        result[axis] = wanted[axis] * share
    for i in range(count):
        if _dot(normals[i], result) < offsets[i] - moved * weights[i] - _TINY and not _on_plane(
            normals, offsets, weights, i, moved, wanted, radius, result
        ):
            return False
    return True


@kernel
def _on_plane(normals, offsets, weights, i, moved, wanted, radius, result):
    """Solve on plane i for the half-spaces before it."""
    offset = offsets[i] - moved * weights[i]
    square = radius * radius - offset * offset
    if square < 0.0:
        return False
    centre = offset * normals[i]
    rest = _dot(normals[i], wanted)
    along = wanted - rest * normals[i]
    length = math.sqrt(_dot(along, along))
    most = math.sqrt(square)
    share = most / length if length > most else 1.0
    for axis in range(3):
        result[axis] = centre[axis] + along[axis] * share
    for j in range(i):
        if _dot(normals[j], result) < offsets[j] - moved * weights[j] - _TINY and not _on_line(
            normals, offsets, weights, i, j, moved, wanted, radius, result
        ):
            return False
    return True


@kernel
def _on_line(normals, offsets, weights, i, j, moved, wanted, radius, result):
    """Solve on the line of planes i and j for the half-spaces before j."""
    cosine = _dot(normals[i], normals[j])
    sine_square = 1.0 - cosine * cosine
    if sine_square < _TINY:
        return False  # parallel planes, and the solution on i violates j
    a, b = offsets[i] - moved * weights[i], offsets[j] - moved * weights[j]
    foot = ((a - b * cosine) * normals[i] + (b - a * cosine) * normals[j]) / sine_square  # nearest to zero
    way = np.cross(normals[i], normals[j]) / math.sqrt(sine_square)
    square = radius * radius - _dot(foot, foot)
    if square < 0.0:
        return False
    high = math.sqrt(square)
    low = -high
    for k in range(j):
        slope = _dot(normals[k], way)
        needed = offsets[k] - moved * weights[k] - _dot(normals[k], foot)
        if abs(slope) < _TINY:
            if needed > _TINY:
                return False
        elif slope > 0.0:
            low = max(low, needed / slope)
        else:
            high = min(high, needed / slope)
    if low > high + _TINY:
        return False
    t = min(max(_dot(wanted, way), low), high)
    for axis in range(3):
        result[axis] = foot[axis] + t * way[axis]
    return True


@kernel
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
