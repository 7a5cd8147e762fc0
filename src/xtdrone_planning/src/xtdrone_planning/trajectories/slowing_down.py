"""Braking along the path of a trajectory: the same positions, at increasing delays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline, first_points

Array = NDArray[np.float64]

_INTERVAL = 0.1  # s between knots
_STILL = 0.05  # m/s
_MOST = 200  # knots


def stopping(spline: UniformSpline, time: float, deceleration: float) -> UniformSpline:
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
