"""How far the rest of a trajectory stays from the points of obstacles. No ROS."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.kernel import kernel
from xtdrone_planning.trajectories.separation import places_at
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline

Array = NDArray[np.float64]

FARTHEST = 2.0
"""Distances are known up to this, m."""

_STEP = 0.1  # m between the places that are checked
_LONGEST_STEP = 0.1  # s
_MOST_PLACES = 10_000  # a trajectory that needs more counts as not clear


class TrajectoryClearance:
    """Distances between a trajectory and points, computed once for each of both."""

    def __init__(self) -> None:
        """Begin without a trajectory."""
        self._points: Array | None = None
        self._control: Array | None = None
        self._interval = self._step = 0.0
        self._least = np.empty(0)

    def least(self, spline: UniformSpline, points: Array, now: float) -> float:
        """Return the least distance, m, from now on: ``FARTHEST`` if it is farther, 0 if the trajectory is too long.

        Args:
            spline: the trajectory; one with the same control points at other times is the same.
            points: shape (K, 3), m; the same array is the same points.
            now: s of ROS time.
        """
        if points is not self._points or spline.points is not self._control or spline.interval != self._interval:
            self._points, self._control, self._interval = points, spline.points, spline.interval
            self._compute(spline, points)
        since = min(max(now - spline.start, 0.0), spline.duration)
        return float(self._least[int(since / self._step)])

    def _compute(self, spline: UniformSpline, points: Array) -> None:
        longest = min(_STEP / max(spline.greatest_speed(), _STEP), _LONGEST_STEP)
        if not spline.duration <= _MOST_PLACES * longest:
            self._step, self._least = spline.duration, np.zeros(2)
            return
        count = math.ceil(spline.duration / longest)
        self._step = spline.duration / count
        places = np.empty((count + 1, 3))
        places_at(spline.points, spline.interval, 0.0, self._step * np.arange(count + 1), places)
        near = (points > places.min(axis=0) - FARTHEST) & (points < places.max(axis=0) + FARTHEST)
        self._least = np.empty(count + 1)
        _least_from(places, points[near.all(axis=1)], FARTHEST, self._least)


@kernel
def _least_from(places, points, farthest, least):
    """Store in ``least`` (n,) the least distance of each place (n, 3) and those after it to points (k, 3), m."""
    least_square = farthest * farthest
    for n in range(len(places) - 1, -1, -1):
        for k in range(len(points)):
            x, y, z = points[k, 0] - places[n, 0], points[k, 1] - places[n, 1], points[k, 2] - places[n, 2]
            least_square = min(least_square, x * x + y * y + z * z)
        least[n] = math.sqrt(least_square)
