"""The estimator of a landing target's motion against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_autopilot.estimator.landing_target_estimator import LandingTargetEstimator
from xtdrone_autopilot.parameters.parameters import Parameters

PERIOD_US = 100_000


def estimator(**changes):
    values = {
        "LTEST_ACC_UNC": 10.0,
        "LTEST_MEAS_UNC": 0.005,
        "LTEST_POS_UNC_IN": 0.1,
        "LTEST_VEL_UNC_IN": 0.1,
        **changes,
    }
    return LandingTargetEstimator(values.__getitem__)


def test_the_defaults_are_those_of_px4():
    get = Parameters().get
    expected = {"MODE": 0, "ACC_UNC": 10.0, "MEAS_UNC": 0.005, "POS_UNC_IN": 0.1, "VEL_UNC_IN": 0.1}
    assert {name: get(f"LTEST_{name}") for name in expected} == pytest.approx(expected)


def test_a_steady_motion_is_found_and_extrapolated():
    target = estimator()
    for k in range(40):
        assert target.see((1.0 + 0.1 * k, -0.05 * k, 3.0), 4.0, k * PERIOD_US)
    motion = target.at(39 * PERIOD_US + 500_000)
    assert motion.position == pytest.approx((1.0 + 4.4, -2.2, 3.0), abs=0.02)
    assert motion.velocity == pytest.approx((1.0, -0.5), abs=0.01)
    assert motion.time_us == 39 * PERIOD_US


def test_a_target_at_rest_without_noise_has_no_velocity():
    target = estimator()
    for k in range(20):
        target.see((2.0, 3.0, 0.0), 10.0, k * PERIOD_US)
    assert target.at(5_000_000).position == (2.0, 3.0, 0.0)
    assert target.at(5_000_000).velocity == (0.0, 0.0)


def test_noise_is_averaged():
    rng = np.random.default_rng(4)
    target = estimator(LTEST_ACC_UNC=0.1, LTEST_MEAS_UNC=0.0025)
    errors = []
    for k in range(400):
        t = 0.1 * k
        target.see((t + rng.normal(0.0, 0.05), rng.normal(0.0, 0.05), 0.0), 1.0, k * PERIOD_US)
        if k > 50:
            motion = target.at(k * PERIOD_US)
            errors.append((motion.position[0] - t, motion.velocity[0] - 1.0))
    place, speed = np.sqrt(np.mean(np.square(errors), axis=0))
    assert place < 0.035
    assert speed < 0.08


def test_an_outlier_is_rejected_and_a_new_place_accepted_after_two_seconds():
    target = estimator()
    for k in range(30):
        target.see((0.0, 0.0, 0.0), 1.0, k * PERIOD_US)
    assert not target.see((5.0, 0.0, 0.0), 1.0, 30 * PERIOD_US)
    assert target.at(30 * PERIOD_US).position[0] == pytest.approx(0.0, abs=1e-9)
    accepted = [target.see((5.0, 0.0, 0.0), 1.0, k * PERIOD_US) for k in range(31, 51)]
    assert accepted[-1]
    assert not accepted[0]
    assert target.at(50 * PERIOD_US).position[0] == pytest.approx(5.0, abs=0.2)


def test_any_parameter_leaves_finite_numbers():
    for acceleration, noise in ((math.inf, 0.005), (math.nan, 0.005), (10.0, math.inf), (-1.0, -1.0)):
        target = estimator(LTEST_ACC_UNC=acceleration, LTEST_MEAS_UNC=noise)
        for k in range(5):
            target.see((0.1 * k, 0.0, 0.0), 1.0, k * PERIOD_US)
        motion = target.at(5 * PERIOD_US)
        assert motion is None or all(map(math.isfinite, (*motion.position, *motion.velocity)))
