"""First position of a neighbour from ranges alone, along the relative motion of both vehicles.

With D the displacement of the neighbour relative to this vehicle from a measurement until now, and a the lever arm of
the antennas, a range is rho = |r - D + a|. The sum of squared errors has several minima: after relative motion along a
straight line, the neighbour may be anywhere on a circle around it; after motion in a plane, on either side.
Gauss-Newton is therefore started in many directions, and there is a fix only if all directions are observable and no
other minimum explains the ranges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DIRECTIONS = 32
_FEW, _STEPS = 40, 15  # ranges and steps for all starts; the minima found are refined with all ranges
_LAST_STEPS = 8
_HUBER = 2.0  # standard deviations beyond which errors count linearly
_RIVAL = 12.0  # difference of normalised squared sums below which another minimum may be the right one
_MARGIN = 4.0  # two standard deviations
_APART = 0.3  # m, between two minima


class Fix(NamedTuple):
    """Position of a neighbour.

    Attributes:
        position: relative to this vehicle, (3,) m, axes of map.
        covariance: (3, 3), m^2.
    """

    position: Array
    covariance: Array


class Ranges(NamedTuple):
    """Ranges over some seconds.

    Attributes:
        measured: (k,) m.
        deviation: their standard deviations, (k,) m.
        shift: lever arm minus displacement until now, a - D, (k, 3) m.
        wander: variance of the displacement per axis, (k,) m^2.
    """

    measured: Array
    deviation: Array
    shift: Array
    wander: Array


def first_fix(ranges: Ranges, height: float, height_deviation: float, worst: float) -> Fix | None:
    """Return the position that explains the ranges; None if there is none, or more than one.

    Args:
        ranges: At least four ranges.
        height: Height of the neighbour above this vehicle, m.
        height_deviation: its standard deviation, m; infinite if unknown.
        worst: maximum standard deviation in any direction, m.
    """
    if len(ranges.measured) < 4:
        return None
    few = np.unique(np.linspace(0, len(ranges.measured) - 1, _FEW).astype(int))
    thinned = Ranges(*(column[few] for column in ranges))
    positions = _descend(_starts(float(np.median(ranges.measured))), thinned, height, height_deviation, _STEPS)
    positions = _descend(_distinct(positions), ranges, height, height_deviation, _LAST_STEPS)
    if not len(positions):
        return None
    _, information, costs = _normal_equations(positions, ranges, height, height_deviation)
    best = int(np.argmin(costs))
    rivals = np.linalg.norm(positions - positions[best], axis=1) > _APART
    if np.any(costs[rivals] < costs[best] + _RIVAL):
        return None
    sound = information[best] - _apparent(positions[best], ranges)
    if float(np.linalg.eigvalsh(sound)[0]) < 1.0 / worst**2:
        return None
    return Fix(positions[best], np.linalg.inv(sound))


def _descend(positions: Array, ranges: Ranges, height: float, height_deviation: float, steps: int) -> Array:
    """Return the positions, (n, 3), after Gauss-Newton steps; diverged ones are dropped."""
    for _ in range(steps):
        gradient, information, _ = _normal_equations(positions, ranges, height, height_deviation)
        damped = information + 1e-6 * np.eye(3) * np.trace(information, axis1=1, axis2=2)[:, None, None]
        positions = positions + np.linalg.solve(damped, gradient[..., None])[..., 0]
    return positions[np.isfinite(positions).all(axis=1)]


def _distinct(positions: Array) -> Array:
    """Return one position per cluster; positions closer than two minima belong to one cluster."""
    kept: list[Array] = []
    for position in positions:
        if all(np.linalg.norm(position - other) > 0.5 * _APART for other in kept):
            kept.append(position)
    return np.array(kept).reshape(-1, 3)


def _apparent(position: Array, ranges: Ranges) -> Array:
    """Return the spurious information, (3, 3), from displacement errors, which look like motion across the line of
    sight.

    An error of variance s^2 per axis rotates the direction u by s / rho, so each term u u' is too large by s^2 / rho^2
    (I - u u') on average; twice the standard deviation is subtracted.
    """
    lines = position + ranges.shift
    lengths = np.maximum(np.linalg.norm(lines, axis=1), 1e-6)
    directions = lines / lengths[:, None]
    share = _MARGIN * ranges.wander / (lengths * ranges.deviation) ** 2
    return np.asarray(np.eye(3) * share.sum() - np.einsum("k,kd,ke->de", share, directions, directions))


def _starts(distance: float) -> Array:
    """Return points on a sphere of a radius, (n, 3) m: a Fibonacci lattice."""
    k = np.arange(_DIRECTIONS) + 0.5
    z = 1.0 - 2.0 * k / _DIRECTIONS
    angle = np.pi * (1.0 + 5.0**0.5) * k
    ring = np.sqrt(1.0 - z * z)
    return np.asarray(distance * np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z]))


def _normal_equations(
    positions: Array, ranges: Ranges, height: float, height_deviation: float
) -> tuple[Array, Array, Array]:
    """Return gradient (n, 3), information (n, 3, 3) and cost (n,) at n positions, with Huber's weights."""
    lines = positions[:, None, :] + ranges.shift
    lengths = np.maximum(np.linalg.norm(lines, axis=2), 1e-6)
    error = (ranges.measured - lengths) / ranges.deviation
    size = np.maximum(np.abs(error), 1e-12)
    weight = np.minimum(1.0, _HUBER / size)
    slope = lines / lengths[..., None] / ranges.deviation[:, None]
    gradient = np.einsum("nk,nkd->nd", weight * error, slope)
    information = np.einsum("nk,nkd,nke->nde", weight, slope, slope)
    cost = np.sum(np.where(size <= _HUBER, error**2, 2.0 * _HUBER * size - _HUBER**2), axis=1)
    if np.isfinite(height_deviation):
        off = (height - positions[:, 2]) / height_deviation
        gradient[:, 2] += off / height_deviation
        information[:, 2, 2] += 1.0 / height_deviation**2
        cost = cost + off**2
    return gradient, information, cost
