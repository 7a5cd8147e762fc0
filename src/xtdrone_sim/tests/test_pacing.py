"""Pacing with a clock moved by the test."""

from __future__ import annotations

import pytest

from xtdrone_sim.runtime.requests.pacing import Pacer, SpeedMeter


@pytest.mark.parametrize("speed", [0.01, 1.0, 5.0])
def test_keeps_the_factor(speed):
    pacer, wall = Pacer(speed), 100.0
    for k in range(1000):
        wall += pacer.delay(4000 * k, wall)
    assert (3.996 / (wall - 100.0)) == pytest.approx(speed)


def test_unlimited_never_waits():
    assert Pacer(0.0).delay(10**9, 0.0) == 0.0


def test_does_not_catch_up_after_a_stall():
    pacer = Pacer(1.0)
    pacer.delay(0, 0.0)
    assert pacer.delay(4000, 10.0) == 0.0
    assert pacer.delay(8000, 10.0) == pytest.approx(0.004)


@pytest.mark.parametrize("speed", [-1.0, 0.009, float("nan"), float("inf")])
def test_rejects_other_speeds(speed):
    with pytest.raises(ValueError, match="speed"):
        Pacer(speed)


def test_a_standstill_is_not_made_up_for():
    pacer = Pacer(1.0)
    pacer.delay(0, 0.0)
    pacer.restart()
    assert pacer.delay(4000, 0.1) == 0.0
    assert pacer.delay(8000, 0.1) == pytest.approx(0.004)


def test_measures_the_last_second():
    meter = SpeedMeter()
    assert meter.factor(0, 0.0) == 0.0
    for k in range(1, 301):  # 3 s at 2 x real time
        factor = meter.factor(20_000 * k, 0.01 * k)
    assert factor == pytest.approx(2.0)
    for k in range(1, 151):  # then it stands still
        factor = meter.factor(6_000_000, 3.0 + 0.01 * k)
    assert factor == 0.0
    meter.restart()
    assert meter.factor(0, 5.0) == 0.0
    assert meter.factor(500_000, 6.0) == pytest.approx(0.5)
