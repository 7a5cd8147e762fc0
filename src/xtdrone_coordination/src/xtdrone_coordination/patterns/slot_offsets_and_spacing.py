"""Offsets: the slots of a formation pattern, as an array, with their checks and scaling.

Offsets of N vehicles have shape (N-1, 3): metres, ENU, row k for slot k+1, relative to the leader (vehicle 0), which is
at the origin. A set of points becomes a pattern by the choice of its leader (``choose_leader``).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Offsets = NDArray[np.float64]

MIN_SEPARATION = 0.5  # m between any two slots: closer vehicles collide
MAX_SPACING = 1000.0  # m
PITCH = 3.0  # m, of the spawn grid, and the minimum distance in grid, circle and sphere
DENSE_PITCH = 2.0  # m, the minimum distance in letters and clouds

_FLOAT32 = 2.0**-21  # offsets travel as 32-bit floats: relative to the largest, a distance may shrink by this
_OBLIQUE = np.array([0.7834, 0.5283, 0.3271])  # about a unit vector, and shorter rather than longer
_ROUNDING = 1.0 + 1e-9


class PatternError(ValueError):
    """A pattern that does not exist or cannot be flown."""


def check_offsets(rows: ArrayLike, count: int, name: str) -> Offsets:
    """Return ``rows`` as an array of shape (count-1, 3).

    Args:
        rows: array-like, m ENU from the leader.
        count: number of vehicles N.
        name: Name of the pattern, for messages.

    Raises:
        PatternError: another shape, not finite, or two slots closer than 0.5 m.
    """
    try:
        offsets = np.array(rows, dtype=float)
    except (TypeError, ValueError) as error:
        raise PatternError(f"{name}: rows must be three numbers each ({str(error)[:100]})") from error
    if offsets.shape != (count - 1, 3):
        shape = " x ".join(str(n) for n in offsets.shape)
        raise PatternError(f"{name}: size {shape}, but {count} vehicles need {count - 1} x 3")
    if not np.isfinite(offsets).all():
        raise PatternError(f"{name}: all offsets must be finite")
    separation = least_separation(offsets)
    if separation < MIN_SEPARATION - _FLOAT32 * float(np.abs(offsets).max()):
        raise PatternError(f"{name}: two vehicles are {separation:.2f} m apart, at least {MIN_SEPARATION} m is allowed")
    return offsets


def least_separation(offsets: Offsets) -> float:
    """Return the minimum distance in metres between any two vehicles of a pattern, the leader at the origin included.

    The vehicles are sorted along a line oblique to all usual lattices; each is compared with the next, the next but
    one, ..., until all remaining pairs are farther apart along the line than the closest pair found so far.
    """
    points = with_leader(offsets)
    along = points @ _OBLIQUE
    order = np.argsort(along, kind="stable")
    points, along = points[order], along[order]
    first = np.arange(len(points))
    least = math.inf
    for step in range(1, len(points)):
        first = first[first < len(points) - step]
        first = first[along[first + step] - along[first] <= least * _ROUNDING]
        if not len(first):
            break
        distances = np.linalg.norm(points[first + step] - points[first], axis=1)
        least = min(least, float(distances.min()))
    return least


def rescaled(offsets: Offsets, spacing: float) -> Offsets:
    """Return the pattern scaled so that its two nearest vehicles are ``spacing`` metres apart."""
    return offsets * (spacing / least_separation(offsets))


def with_leader(offsets: Offsets) -> Offsets:
    """Return the offsets of all N vehicles, shape (N, 3): the leader's zero row before the followers'."""
    return np.vstack([np.zeros(3), offsets])


def slots_of_all(offsets: ArrayLike, count: int) -> list[tuple[float, float, float]]:
    """Return the slots of all ``count`` vehicles, the leader's zero first, from those of the followers.

    Raises:
        PatternError: another size than (count-1, 3), not finite, or slots too close to each other.
    """
    checked = check_offsets(offsets, count, "formation pattern")
    return [(x, y, z) for x, y, z in with_leader(checked).tolist()]


Points = NDArray[np.float64]

_AS_HIGH = 1e-6  # of the shape's height: points less than this below the highest count as equally high
ALL_AS_HIGH = 0.1  # the same for letters and clouds, where exactly equal heights are not to be expected


def farthest(points: Points, count: int) -> NDArray[np.intp]:
    """Return the indices of ``count`` evenly spread points: each is the farthest from those before it.

    The first is the one farthest from the mean. Fewer are returned if there are not enough different points.

    Args:
        points: shape (M, D).
        count: number of points to select.
    """
    columns = [np.ascontiguousarray(column) for column in points.T]
    far = _squares(columns, points.mean(axis=0))
    chosen = [int(far.argmax())]
    far = _squares(columns, points[chosen[0]])
    while len(chosen) < count:
        last = int(far.argmax())
        if far[last] <= 0.0:
            break
        chosen.append(last)
        np.minimum(far, _squares(columns, points[last]), out=far)
    return np.array(chosen)


def _squares(columns: list[Points], place: Points) -> Points:
    """Return the squared distances of points, given by columns, from a place."""
    total = (columns[0] - place[0]) ** 2
    for column, value in zip(columns[1:], place[1:], strict=True):
        total += (column - value) ** 2
    return total


def choose_leader(points: Points, as_high: float = _AS_HIGH) -> Offsets:
    """Return the offsets of all other points from the leader, the most central of the highest points."""
    height = points[:, 2]
    high = np.flatnonzero(height >= height.max() - as_high * float(np.ptp(height)))
    leader = high[distance_from_middle(points)[high].argmin()]
    return np.delete(points, leader, axis=0) - points[leader]


def distance_from_middle(points: Points) -> Points:
    """Return the horizontal distances from the middle of the bounding box, rounded so that equal ones compare equal."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return np.hypot(*(points - middle)[:, :2].T).round(9)
