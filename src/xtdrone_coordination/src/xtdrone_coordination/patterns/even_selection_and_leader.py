"""Sets of points as patterns: even selection, and the choice of the leader among them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .slot_offsets_and_spacing import Offsets

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


def led(points: Points, as_high: float = _AS_HIGH) -> Offsets:
    """Return the offsets of all other points from the leader, the most central of the highest points."""
    height = points[:, 2]
    high = np.flatnonzero(height >= height.max() - as_high * float(np.ptp(height)))
    leader = high[from_middle(points)[high].argmin()]
    return np.delete(points, leader, axis=0) - points[leader]


def from_middle(points: Points) -> Points:
    """Return the horizontal distances from the middle of the bounding box, rounded so that equal ones compare equal."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return np.hypot(*(points - middle)[:, :2].T).round(9)
