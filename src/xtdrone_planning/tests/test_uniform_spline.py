"""Uniform B-splines: values, exact limits, stopping, and messages."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_planning.trajectories.speed_profile import SpeedProfile, brake_along, points_along
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline, first_points, resting


def a_spline(seed: int) -> UniformSpline:
    rng = np.random.default_rng(seed)
    return UniformSpline(3.0, 0.3, np.cumsum(rng.uniform(-0.5, 1.0, (12, 3)), axis=0))


def test_it_begins_in_the_given_state():
    state = [np.array([1.0, 2.0, 3.0]), np.array([0.5, -1.0, 0.2]), np.array([0.1, 2.0, -0.7])]
    spline = UniformSpline(0.0, 0.25, np.vstack([first_points(*state, 0.25), np.zeros((4, 3))]))
    assert np.allclose(spline.at(0.0), state)


def test_velocity_and_acceleration_are_derivatives():
    spline, step = a_spline(1), 1e-5
    for time in np.linspace(3.05, spline.end - 0.05, 40):
        before, at, after = spline.at(time - step), spline.at(time), spline.at(time + step)
        assert np.allclose((after[0] - before[0]) / (2 * step), at[1], atol=1e-6)
        assert np.allclose((after[1] - before[1]) / (2 * step), at[2], atol=1e-3)


@pytest.mark.parametrize("seed", range(20))
def test_greatest_speed_and_acceleration_are_exact(seed):
    spline = a_spline(seed)
    states = [spline.at(time) for time in np.linspace(spline.start, spline.end, 6001)]
    speed = max(np.linalg.norm(state[1]) for state in states)
    acceleration = max(np.linalg.norm(state[2]) for state in states)
    assert spline.greatest_speed() >= speed - 1e-9
    assert spline.greatest_speed() == pytest.approx(speed, rel=1e-5)
    assert spline.greatest_acceleration() >= acceleration - 1e-9
    assert spline.greatest_acceleration() == pytest.approx(acceleration, rel=2e-3)


@pytest.mark.parametrize("seed", range(20))
def test_the_lowest_and_highest_points_are_exact(seed):
    points = np.random.default_rng(seed).normal(0.0, 1.0, (9, 3))
    if seed == 0:
        points[:, 2] = np.arange(9.0)  # a line: nowhere does it turn
    spline = UniformSpline(0.0, 0.3, points)
    heights = spline.positions(np.linspace(0.0, spline.end, 6001))[:, 2]
    low, high = spline.heights()
    assert low <= heights.min() + 1e-12
    assert high >= heights.max() - 1e-12
    assert (low, high) == pytest.approx((heights.min(), heights.max()), abs=1e-5)


def test_a_resting_vehicle_rests():
    spline = resting(np.array([1.0, 2.0, 3.0]), 5.0)
    for time in (0.0, 5.0, 5.5, 100.0):
        assert np.allclose(spline.at(time), [[1, 2, 3], [0, 0, 0], [0, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_stopping_stays_on_the_path_and_ends_at_rest(seed):
    corners = np.array([[0.0, 0, 2], [4, 0, 2], [7, 3, 2], [12, 3, 2.5]])
    law = SpeedProfile.along(12.0, 0.0, 4.0, 2.0)
    points = points_along(corners, law.way(np.arange(-1, 26) * 0.2))
    spline = UniformSpline(0.0, 0.2, np.vstack([points, points[-1], points[-1]]))
    begin = 1.0 + 0.4 * seed
    stopped = brake_along(spline, begin, 2.5)
    assert np.allclose(stopped.at(begin)[:2], spline.at(begin)[:2])
    assert np.allclose(stopped.at(stopped.end)[1:], 0.0)
    path = spline.positions(np.linspace(0.0, spline.end, 5000))
    for place in stopped.positions(np.linspace(begin, stopped.end, 200)):
        assert np.linalg.norm(path - place, axis=1).min() < 0.03
    speed = np.linalg.norm(spline.at(begin)[1])
    way = np.linalg.norm(np.diff(stopped.positions(np.linspace(begin, stopped.end, 500)), axis=0), axis=1).sum()
    assert way < speed * speed / (2 * 2.5) + 0.5


@pytest.mark.parametrize(("length", "speed"), [(10.0, 0.0), (10.0, 3.0), (1.0, 0.0), (1.0, 3.0), (3.0, 6.0)])
def test_the_time_law_ends_at_the_end(length, speed):
    law = SpeedProfile.along(length, speed, 4.0, 2.0)
    times = np.linspace(0.0, law.duration, 2001)
    ways = law.way(times)
    assert ways[0] == 0.0
    assert ways[-1] == pytest.approx(length)
    speeds = np.diff(ways) / np.diff(times)
    assert (speeds > -1e-9).all()
    assert speeds.max() <= max(4.0, speed) + 1e-6
    assert speeds[0] == pytest.approx(max(speed, 0.0), abs=0.1)
