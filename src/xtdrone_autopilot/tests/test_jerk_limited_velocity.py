"""Jerk-limited smoothing against its own limits and against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_autopilot.flight_tasks.motion_planning import jerk_limited_velocity
from xtdrone_autopilot.state import PATH

DT = 0.02


def fly(wanted, accel=(3.0, 3.0, 3.0), jerk=4.0, seconds=8.0, start=(0.0, 0.0, 0.0)):
    """Return accelerations, velocities and positions, (n, 3) each, of a path without initial acceleration."""
    path = np.zeros(1, PATH)[0]
    path["velocity"] = start
    rows = []
    for _ in range(round(seconds / DT)):
        jerk_limited_velocity.plan(path, wanted, (20.0, 20.0, 20.0), accel, jerk)
        for axis in range(3):
            jerk_limited_velocity.follow(path, axis, jerk, DT)
        rows.append([path["acceleration"].copy(), path["velocity"].copy(), path["position"].copy()])
    return tuple(np.array(part) for part in zip(*rows, strict=True))


@pytest.mark.parametrize("wanted", [(5.0, 0.0, 0.0), (-2.0, 3.0, 1.0), (0.4, -0.1, 0.0)])
def test_path_reaches_its_velocity_within_its_limits(wanted):
    a, v, x = fly(wanted)
    np.testing.assert_allclose(v[-1], wanted, atol=1e-6)
    np.testing.assert_allclose(a[-1], 0.0, atol=1e-6)
    assert np.abs(a).max() <= 3.0 + 1e-9
    assert np.abs(np.diff(a, axis=0)).max() <= 4.0 * DT + 1e-9
    np.testing.assert_allclose(np.gradient(x, DT, axis=0)[1:-1], v[1:-1], atol=4.0 * DT * DT)


def test_time_of_a_long_change_is_the_least_one():
    """From rest to v it takes v / a + a / j: a / j of rising and a / j of falling acceleration, the rest at a."""
    _, v, _ = fly((6.0, 0.0, 0.0))
    time = DT * (np.argmax(v[:, 0] > 6.0 - 1e-6) + 1)
    assert time == pytest.approx(6.0 / 3.0 + 3.0 / 4.0, abs=2 * DT)


def test_axes_arrive_together():
    _, v, _ = fly((6.0, 1.5, 0.0))
    arrivals = [np.argmax(np.abs(v[:, axis] - wanted) < 1e-3) for axis, wanted in ((0, 6.0), (1, 1.5))]
    assert abs(arrivals[0] - arrivals[1]) <= 5


def test_velocity_is_limited():
    path = np.zeros(1, PATH)[0]
    for _ in range(400):
        jerk_limited_velocity.plan(path, (50.0, 0.0, -50.0), (5.0, 5.0, 1.5), (3.0, 3.0, 3.0), 4.0)
        for axis in range(3):
            jerk_limited_velocity.follow(path, axis, 4.0, DT)
    np.testing.assert_allclose(path["velocity"], (5.0, 0.0, -1.5), atol=1e-6)


@pytest.mark.parametrize("final", [0.0, 1.7])
@pytest.mark.parametrize("distance", [0.1, 2.0, 50.0])
def test_stopping_speed_suffices_to_slow_down(distance, final):
    """The distance is (v^2 - final^2) / (2 a) + 2 v a / j; the last term is the build-up of the deceleration."""
    accel, jerk = 3.0, 4.0
    speed = jerk_limited_velocity.stopping_speed(distance, accel, jerk, final)
    if speed > final:
        assert (speed**2 - final**2) / (2 * accel) + 2 * speed * accel / jerk == pytest.approx(distance)
    else:
        assert (2 * final * accel / jerk) >= distance


def test_turning_speed_of_a_right_angle():
    assert jerk_limited_velocity.turning_speed(0.5 * math.pi, 1.5, 2.0) == pytest.approx(math.sqrt(3.0))
    assert jerk_limited_velocity.turning_speed(math.pi, 1.5, 2.0) > 50.0
    assert jerk_limited_velocity.turning_speed(0.0, 1.5, 2.0) == 0.0
