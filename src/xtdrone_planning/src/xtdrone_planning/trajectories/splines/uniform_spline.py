"""Trajectories as uniform cubic B-splines: position, velocity and acceleration are continuous, the jerk is bounded.

L. Qin, General matrix representations for B-splines, Pacific Graphics 1998; as a trajectory: V. Usenko et al.,
Real-time trajectory replanning for MAVs using uniform B-splines and a 3D circular buffer, IROS 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.trajectories.splines.spline_kernels import (
    extremes,
    greatest_acceleration,
    greatest_speed,
    spline_at,
)

Array = NDArray[np.float64]

_COASTING = 30  # s


@dataclass(frozen=True)
class UniformSpline:
    """A trajectory; before its start and after its end, the vehicle is at rest at its ends.

    Attributes:
        start: s of ROS time.
        interval: s between two knots.
        points: (n, 3) control points, n at least 4, m in map. Between knots k and k + 1, k from 0, the trajectory
            depends on points k to k + 3.
    """

    start: float
    interval: float
    points: Array

    @property
    def duration(self) -> float:
        """Time from start to end, s."""
        return self.interval * (len(self.points) - 3)

    @property
    def end(self) -> float:
        """ROS time of the end, s."""
        return self.start + self.duration

    def at(self, time: float) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration, (3,) each, m, m/s, m/s^2, at a ROS time, s."""
        since = min(max(time - self.start, 0.0), self.duration)
        state = spline_at(self.points, self.interval, since)
        if time > self.end:
            state[1:] = 0.0
        return state[0], state[1], state[2]

    def positions(self, times: Array) -> Array:
        """Return the positions (n, 3), m, at ROS times (n,), s."""
        return np.array([self.at(float(time))[0] for time in times]).reshape(-1, 3)

    def greatest_speed(self) -> float:
        """Return the maximum speed, m/s, exactly."""
        return float(greatest_speed(self.points, self.interval))

    def greatest_acceleration(self) -> float:
        """Return the maximum acceleration, m/s^2, exactly."""
        return float(greatest_acceleration(self.points, self.interval))

    def heights(self) -> tuple[float, float]:
        """Return the minimum and maximum height, m, exactly."""
        low, high = extremes(self.points, 2)
        return float(low), float(high)


def resting(position: Array, time: float) -> UniformSpline:
    """Return the trajectory of a vehicle that hovers at (3,) m in map from a ROS time, s, onwards."""
    return UniformSpline(time, 1.0, np.tile(np.asarray(position, float), (4, 1)))


def coasting(position: Array, velocity: Array, time: float) -> UniformSpline:
    """Return the trajectory from a position, (3,) m in map, with a constant velocity, (3,) m/s, for some seconds."""
    interval = 1.0
    points = position + velocity * interval * (np.arange(_COASTING + 3)[:, None] - 1.0)
    return UniformSpline(time, interval, points)


def first_points(position: Array, velocity: Array, acceleration: Array, interval: float) -> Array:
    """Return the three control points (3, 3) that give a spline its initial state.

    Args:
        position, velocity, acceleration: (3,) m, m/s, m/s^2 in map.
        interval: s between knots.
    """
    bend = acceleration * interval * interval
    middle = position - bend / 6.0
    half = velocity * interval
    return np.stack([middle + 0.5 * bend - half, middle, middle + 0.5 * bend + half])
