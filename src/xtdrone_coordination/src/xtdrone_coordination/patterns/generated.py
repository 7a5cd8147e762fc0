"""Patterns generated for any number of vehicles: the families of XTDrone's patterns, and grid, circle and sphere."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from xtdrone_coordination.patterns.slot_offsets_and_spacing import choose_leader, distance_from_middle

from .slot_offsets_and_spacing import PITCH, Offsets, rescaled

_SPHERE_SHIFT = 0.36  # of a step: distance of the lattice's ends from the poles for the largest minimum distance
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


def origin_columns(count: int) -> int:
    """Return the number of vehicles in a row along x of the pattern ``origin``, which is the spawn grid."""
    return {6: 2, 9: 3, 18: 3}.get(count, max(1, round(math.sqrt(count))))


def origin(count: int) -> Offsets:
    """Return the spawn grid, filled along x first."""
    columns = origin_columns(count)
    return np.array([(PITCH * (i % columns), PITCH * (i // columns), 0.0) for i in range(1, count)])


def cube(count: int) -> Offsets:
    """Return the smallest cubic lattice around the leader, filled from its corners inwards."""
    side = 2
    while side**3 - side % 2 < count - 1:  # the middle of an odd lattice is the leader's
        side += 1
    pitch = 4.0 if side == 2 else PITCH
    axis = [pitch * (k - (side - 1) / 2) for k in range(side)]
    points = [(x, y, z) for z in reversed(axis) for y in axis for x in axis if (x, y, z) != (0.0, 0.0, 0.0)]
    points.sort(key=lambda p: -(p[0] ** 2 + p[1] ** 2 + p[2] ** 2))  # stable: upper layers first
    return np.array(points[: count - 1])


def pyramid(count: int) -> Offsets:
    """Return square rings below the leader: layer k at z = -2k has side 4k and a vehicle every 4 m, corners first."""
    points: list[tuple[float, float, float]] = []
    layer = 0
    while len(points) < count - 1:
        layer += 1
        half = 2.0 * layer
        steps = [4.0 * k - half for k in range(layer)]  # one side without its last corner
        ring = [p for s in steps for p in ((s, -half), (half, s), (-s, half), (-half, -s))]
        points += [(x, y, -2.0 * layer) for x, y in ring]
    return np.array(points[: count - 1])


def triangle(count: int) -> Offsets:
    """Return an upright triangle in the y-z plane: row k at z = -2k has 2k+1 vehicles 2 m apart, middle first."""
    points: list[tuple[float, float, float]] = []
    row = 0
    while len(points) < count - 1:
        row += 1
        points += [(0.0, 2.0 * y, -2.0 * row) for y in sorted(range(-row, row + 1), key=abs)]
    return np.array(points[: count - 1])


def grid(count: int, spacing: float) -> Offsets:
    """Return a level square grid: the ``count`` places nearest to its middle, where the leader is."""
    side = math.ceil(math.sqrt(count))
    cells = np.array([(column, -row, 0.0) for row in range(side) for column in range(side)], dtype=float)
    nearest_first = np.argsort(distance_from_middle(cells), kind="stable")
    return choose_leader(spacing * cells[np.sort(nearest_first[:count])])


def circle(count: int, spacing: float) -> Offsets:
    """Return a level circle; the leader is on its east side, which is ahead after takeoff."""
    radius = 0.5 * spacing / math.sin(math.pi / count)
    angle = 2.0 * math.pi * np.arange(count) / count
    points = radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    return points[1:] - points[0]


def sphere(count: int, spacing: float) -> Offsets:
    """Return a sphere below the leader, evenly covered by a Fibonacci lattice.

    The ends of the lattice are moved away from the poles, which increases the minimum distance (M. Roberts, Evenly
    distributing points on a sphere, 2018).
    """
    index = np.arange(count)
    height = 1.0 - 2.0 * (index + _SPHERE_SHIFT) / (count - 1 + 2.0 * _SPHERE_SHIFT)
    radius, angle = np.sqrt(1.0 - height**2), _GOLDEN_ANGLE * index
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
    return rescaled(choose_leader(points), spacing)


FAMILIES: dict[str, Callable[[int], Offsets]] = {
    "origin": origin,
    "cube": cube,
    "pyramid": pyramid,
    "triangle": triangle,
}
"""Patterns of a fixed size, from the number of vehicles."""

SHAPES: dict[str, Callable[[int, float], Offsets]] = {"grid": grid, "circle": circle, "sphere": sphere}
"""Patterns of any size, from the number of vehicles and the minimum distance of two of them, m."""
