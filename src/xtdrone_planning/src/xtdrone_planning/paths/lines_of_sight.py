"""Kernels on lines through the map: visible length, and shortcuts of paths."""

from __future__ import annotations

import math

import numpy as np

from xtdrone_planning.kernel import kernel
from xtdrone_planning.mapping.field_lookup import distance_at, is_seen


@kernel
def is_open(distance, evidence, corner, resolution, a, b, clearance, radius):
    """Return whether a straight line is clear of obstacles and has been seen.

    Args:
        distance, evidence, corner, resolution: the map.
        a, b: (3,) ends, m.
        clearance: minimum distance to an obstacle, m.
        radius: of the disc that must have been seen around each point, m; 0: only the line itself; below 0: nothing.
    """
    length = math.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
    steps = max(1, math.ceil(2.0 * length / resolution))
    for n in range(steps + 1):
        part = n / steps
        x, y, z = a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), a[2] + part * (b[2] - a[2])
        if distance_at(distance, corner, resolution, x, y, z)[0] < clearance:
            return False
        if radius >= 0.0 and not is_seen(evidence, corner, resolution, x, y, z, radius):
            return False
    return True


@kernel
def is_clear(distance, corner, resolution, a, b, clearance):
    """Return whether a straight line is clear of obstacles; if it starts too close to one, it may lead away.

    Args:
        distance, corner, resolution: the map.
        a, b: (3,) ends, m.
        clearance: minimum distance to an obstacle, m.
    """
    length = math.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
    steps = max(1, math.ceil(2.0 * length / resolution))
    before = clearance
    for n in range(steps + 1):
        part = n / steps
        x, y, z = a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), a[2] + part * (b[2] - a[2])
        away = distance_at(distance, corner, resolution, x, y, z)[0]
        if away < clearance and (away <= 0.0 or (n > 0 and away < before)):
            return False
        before = min(clearance, away)
    return True


@kernel
def seen_count(evidence, corner, resolution, points, radius, exempt, farthest):
    """Return how many of the first points have been seen, each with a disc around it.

    Args:
        evidence, corner, resolution: the map.
        points: (n, 3) m.
        radius: Radius of the disc, m.
        exempt: points within this path length from the start need not have been seen: the vehicle is there, m.
        farthest: points beyond this path length from the start do not count, m.
    """
    way = 0.0
    for n in range(len(points)):
        if n > 0:
            u, v, w = points[n] - points[n - 1]
            way += math.sqrt(u * u + v * v + w * w)
        if way > farthest:
            return n
        if way > exempt and not is_seen(evidence, corner, resolution, points[n, 0], points[n, 1], points[n, 2], radius):
            return n
    return len(points)


@kernel
def without_corners(distance, evidence, corner, resolution, points, clearance, radius):
    """Shorten a path: return the points (m, 3) that remain after replacing corners by clear straight lines.

    Args:
        distance, evidence, corner, resolution: the map.
        points: (n, 3) m; the first and last are kept.
        clearance, radius: see ``is_open``; lines between adjacent points are not checked.
    """
    kept = np.empty_like(points)
    kept[0] = points[0]
    count, at = 1, 0
    while at < len(points) - 1:
        to = at + 1
        for other in range(len(points) - 1, at + 1, -1):
            if is_open(distance, evidence, corner, resolution, points[at], points[other], clearance, radius):
                to = other
                break
        kept[count] = points[to]
        count += 1
        at = to
    return kept[:count]
