"""Offsets: the slots of a formation pattern, as an array, with their checks and scaling.

Offsets of N vehicles have shape (N-1, 3): metres, ENU, row k for slot k+1, relative to the leader (vehicle 0), which is
at the origin.
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
        name: of the pattern, for messages.

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
