"""Speeds along a line: accelerate, cruise, and stop at the end; and braking along the path of a trajectory."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline, first_points

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SpeedProfile:
    """Distance over time with constant accelerations, from ``speed`` to ``peak`` to rest.

    Attributes:
        length: Length of the line, m.
        speed: Speed at the start, m/s.
        peak: maximum speed, m/s.
        acceleration: when speeding up and when braking, m/s^2; braking is stronger where the line is too short.
    """

    length: float
    speed: float
    peak: float
    acceleration: float

    @classmethod
    def along(cls, length: float, speed: float, limit: float, acceleration: float) -> SpeedProfile:
        """Return the fastest profile with speeds up to ``limit``, m/s; from a higher ``speed`` it brakes at once."""
        reachable = math.sqrt(acceleration * length + 0.5 * speed * speed)
        return cls(length, speed, max(speed, min(limit, reachable)), acceleration)

    @property
    def _parts(self) -> tuple[float, float, float, float]:
        """Duration and distance of acceleration; duration and distance of braking."""
        rise = (self.peak - self.speed) / self.acceleration
        rise_way = 0.5 * (self.peak + self.speed) * rise
        fall_way = min(0.5 * self.peak * self.peak / self.acceleration, self.length - rise_way)
        return rise, rise_way, 2.0 * fall_way / self.peak if self.peak > 0.0 else 0.0, fall_way

    @property
    def duration(self) -> float:
        """Time to the end, s."""
        rise, rise_way, fall, fall_way = self._parts
        return rise + fall + (self.length - rise_way - fall_way) / self.peak if self.peak > 0.0 else 0.0

    def way(self, times: Array) -> Array:
        """Return the distance (n,), m, at times (n,), s; 0 before the start and ``length`` after the end."""
        rise, rise_way, fall, _ = self._parts
        total = self.duration
        t = np.clip(times, 0.0, total)
        rising = self.speed * t + 0.5 * self.acceleration * t * t
        level = rise_way + self.peak * (t - rise)
        left = total - t
        falling = self.length - (0.5 * self.peak / fall * left * left if fall > 0.0 else 0.0 * left)
        return np.where(t < rise, rising, np.where(left > fall, level, falling))


def points_along(corners: Array, ways: Array) -> Array:
    """Return the points (n, 3) at distances (n,), m, along a line of ``corners`` (m, 3)."""
    sides = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    reached = np.concatenate([[0.0], np.cumsum(sides)])
    return np.stack([np.interp(ways, reached, corners[:, c]) for c in range(3)], axis=1)


def length_of(corners: Array) -> float:
    """Return the length of a line of ``corners`` (n, 3), m."""
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())


_INTERVAL = 0.1  # s between knots
_STILL = 0.05  # m/s
_MOST = 200  # knots


def brake_along(spline: UniformSpline, time: float, deceleration: float) -> UniformSpline:
    """Return a trajectory that brakes along the path of another one.

    Args:
        spline: the current trajectory.
        time: start of braking, s of ROS time.
        deceleration: m/s^2.

    Returns:
        A trajectory that begins at ``time`` with position and velocity of the given one, follows its path (to fourth
        order in the interval of 0.1 s), and ends at rest.
    """
    position, velocity, acceleration = spline.at(time)
    places = _slower_places(spline, time, deceleration)
    speed = _length(velocity)
    if speed > _STILL:
        along = float((velocity * acceleration).sum()) / speed
        acceleration = acceleration - (along + max(deceleration, -along)) * velocity / speed
    inner = places[2:-1] - (places[1:-2] - 2.0 * places[2:-1] + places[3:]) / 6.0
    first = first_points(position, velocity, acceleration, _INTERVAL)
    return UniformSpline(time, _INTERVAL, np.vstack([first, inner, np.tile(places[-1], (3, 1))]))


def _slower_places(spline: UniformSpline, time: float, deceleration: float) -> Array:
    """Return the positions (n, 3), m, at the knots of the braking trajectory; at least 4."""
    places, at, rate = [spline.at(time)[0]], time, 1.0
    while len(places) < _MOST:
        _, velocity, acceleration = spline.at(at)
        speed = _length(velocity)
        if speed * rate <= _STILL or at >= spline.end:
            break
        along = float((velocity * acceleration).sum()) / speed * rate * rate
        slower = rate - max(0.0, deceleration + along) * _INTERVAL / speed
        if slower <= 0.0:
            break
        at += 0.5 * (rate + slower) * _INTERVAL
        rate = slower
        places.append(spline.at(at)[0])
    at += 0.5 * rate * rate * _length(spline.at(at)[1]) / deceleration
    last = spline.at(at)[0]
    return np.array([*places, *[last] * max(1, 4 - len(places))])


def _length(vector: Array) -> float:
    return float(np.sqrt((vector * vector).sum()))
