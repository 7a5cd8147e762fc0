"""Trajectories of other vehicles, as moving obstacles."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.mapping.voxel_grid import VoxelGrid
from xtdrone_planning.trajectories.separation import first_approach, places_at, shorten_near
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline

Array = NDArray[np.float64]

_COMFORT = 0.5  # m beyond the minimum distance, within which proximity adds cost
_LEAST_POINTS = 4


class MovingVehicles:
    """Trajectories of other vehicles, with the clearance to each."""

    def __init__(self, trajectories: Sequence[UniformSpline] = (), distances: Sequence[float] = ()) -> None:
        """Store the trajectories and the minimum distances, m, between the vehicles' centres."""
        self._trajectories = tuple(trajectories)
        self._distances = np.array(distances, dtype=np.float64)
        most = max((len(spline.points) for spline in self._trajectories), default=_LEAST_POINTS)
        self._points = np.zeros((len(self._trajectories), most, 3))
        for row, spline in zip(self._points, self._trajectories, strict=True):
            row[: len(spline.points)] = spline.points
        self._counts = np.array([len(spline.points) for spline in self._trajectories], dtype=np.int64)
        self._intervals = np.array([spline.interval for spline in self._trajectories], dtype=np.float64)
        self._starts = np.array([spline.start for spline in self._trajectories], dtype=np.float64)

    @property
    def apart(self) -> Array:
        """Distances (m,) below which proximity adds cost, m."""
        return self._distances + _COMFORT

    def places(self, times: Array) -> Array:
        """Return the positions of the others at ROS times (n,), s: (n, m, 3), m."""
        found = np.empty((len(self._trajectories), len(times), 3))
        for places, spline in zip(found, self._trajectories, strict=True):
            places_at(spline.points, spline.interval, spline.start, times, places)
        return np.ascontiguousarray(found.transpose(1, 0, 2))

    def near_rest(self, grid: VoxelGrid, clearance: float) -> NDArray[np.float32]:
        """Return the distances of a map, m, reduced around the positions where the others come to rest.

        Where another vehicle is closer than allowed they are below ``clearance``, m, so that paths avoid it.
        """
        distance = grid.distance.copy()
        places = np.array([spline.points[-1] for spline in self._trajectories]).reshape(-1, 3)
        shorten_near(distance, grid.corner, grid.resolution, places, self._distances + grid.resolution, clearance)
        return distance

    def __len__(self) -> int:
        """Return the number of trajectories."""
        return len(self._trajectories)

    def conflict_time(self, spline: UniformSpline, begin: float, until: float = math.inf) -> float:
        """Return the ROS time, s, from ``begin`` to ``until``, at which a trajectory is too close to another; inf:
        never."""
        end = min(until, max((other.end for other in (spline, *self._trajectories)), default=begin))
        return float(
            first_approach(
                spline.points,
                spline.interval,
                spline.start,
                self._points,
                self._intervals,
                self._starts,
                self._counts,
                self._distances,
                begin,
                max(begin, end),
            )
        )


NO_VEHICLES = MovingVehicles()
