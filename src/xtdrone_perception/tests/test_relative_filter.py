"""Relative positions from ranges, bearings and odometry: exact without noise, within the covariance with it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from xtdrone_perception.localisation.relative_filter import FilterSettings, RelativeFilter

DT = 1.0 / 30.0
START = np.array([3.0, -2.0, 1.0])


def turning(t: float) -> np.ndarray:
    return np.array([math.cos(0.5 * t), 1.2 * math.sin(0.4 * t), 0.3 * math.cos(0.9 * t)])


def straight(t: float) -> np.ndarray:
    return np.array([math.copysign(1.0, math.sin(0.3 * t)), 0.0, 0.0])


def still(_: float) -> np.ndarray:
    return np.zeros(3)


@dataclass
class Trial:
    """A flight of two vehicles; measurements of the second by the first."""

    motion: Callable[[float], np.ndarray]
    seed: int = 0
    noise: float = 0.1  # m
    drift: float = 0.05  # m/sqrt(s)
    bearing: float = 0.0  # rad; 0: none
    outliers: float = 0.0
    errors: list[np.ndarray] = field(default_factory=list)
    normalised: list[float] = field(default_factory=list)

    def fly(self, seconds: float) -> RelativeFilter:
        rng = np.random.default_rng(self.seed)
        one, r = RelativeFilter(FilterSettings(drift=self.drift)), START.copy()
        height_error = rng.normal(0.0, 0.3) if self.noise else 0.0
        for k in range(round(seconds / DT)):
            velocity = self.motion(k * DT)
            r = r + velocity * DT
            one.predict(DT, velocity - rng.normal(0.0, self.drift / math.sqrt(DT), 3) * (self.noise > 0.0))
            one.add_height(r[2] + height_error)
            self.measure(one, r, rng)
            if one.known:
                error = one.position - r
                self.errors.append(error)
                self.normalised.append(float(error @ np.linalg.solve(one.covariance, error)))
        return one

    def measure(self, one: RelativeFilter, r: np.ndarray, rng: np.random.Generator) -> None:
        excess = rng.exponential(3.0) if rng.random() < self.outliers else 0.0
        measured = float(np.linalg.norm(r)) + rng.normal(0.0, 1.0) * self.noise + excess
        one.add_range(measured, max(self.noise, 1e-3), np.zeros(3))
        if self.bearing:
            azimuth = math.atan2(r[1], r[0]) + rng.normal(0.0, self.bearing)
            elevation = math.atan2(r[2], math.hypot(r[0], r[1])) + rng.normal(0.0, self.bearing)
            one.add_bearing(azimuth, elevation, self.bearing, np.eye(3), np.zeros(3), measured)


def test_without_noise_the_position_is_exact() -> None:
    trial = Trial(turning, noise=0.0, drift=0.0)
    trial.fly(20.0)
    assert len(trial.errors) > 300
    assert np.abs(trial.errors[-1]).max() < 1e-3


@pytest.mark.parametrize("bearing", [0.0, 0.05])
def test_errors_are_within_the_covariance(bearing: float) -> None:
    trials = [Trial(turning, seed, bearing=bearing) for seed in range(6)]
    for trial in trials:
        trial.fly(25.0)
    squares = [np.mean(trial.normalised) for trial in trials]
    assert 1.5 < np.mean(squares) < 5.0  # 3 expected; correlated within a flight
    assert np.median([np.linalg.norm(error) for trial in trials for error in trial.errors]) < (0.1 if bearing else 0.25)


def test_outliers_are_rejected() -> None:
    trial = Trial(turning, 3, bearing=0.05, outliers=0.05)
    one = trial.fly(20.0)
    assert one.outliers > 15
    assert np.linalg.norm(trial.errors, axis=1)[100:].max() < 0.4


@pytest.mark.parametrize("motion", [straight, still])
def test_ranges_without_a_turning_motion_give_no_position(motion: Callable[[float], np.ndarray]) -> None:
    for seed in range(3):
        trial = Trial(motion, seed)
        one = trial.fly(30.0)
        assert not one.known
        assert trial.errors == []
        assert np.isnan(one.position).all()


def test_a_bearing_gives_a_position_at_once_and_without_any_motion() -> None:
    trial = Trial(still, 1, bearing=0.05)
    one = trial.fly(10.0)
    assert len(trial.errors) > 290
    assert np.linalg.norm(trial.errors[-1]) < 0.15
    assert one.deviation < 0.1


def test_an_unknown_jump_leads_to_a_new_start() -> None:
    rng = np.random.default_rng(5)
    trial = Trial(still, bearing=0.05)
    one = RelativeFilter(FilterSettings())
    for place in (START, np.add(START, (6.0, 5.0, 0.0))):
        for _ in range(120):
            one.predict(DT, np.zeros(3))
            trial.measure(one, place, rng)
        assert one.position == pytest.approx(place, abs=0.3)


def test_values_that_are_no_ranges_change_nothing() -> None:
    one = Trial(still, bearing=0.05).fly(2.0)
    before = one.position.copy()
    for value in (math.nan, math.inf, -1.0, 0.0):
        one.add_range(value, 0.1, np.zeros(3))
    one.add_height(math.nan)
    assert np.array_equal(one.position, before)
