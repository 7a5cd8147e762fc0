"""Pacing by a clock that the test moves."""

from __future__ import annotations

import pytest

from xtdrone_sim.pacing import Pacer


@pytest.mark.parametrize("speed", [0.1, 1.0, 5.0])
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


@pytest.mark.parametrize("speed", [-1.0, 0.01, float("nan"), float("inf")])
def test_refuses_other_speeds(speed):
    with pytest.raises(ValueError, match="speed"):
        Pacer(speed)
