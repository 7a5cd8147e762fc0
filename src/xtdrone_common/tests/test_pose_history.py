"""Poses interpolated between messages."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_common.pose_history import PoseHistory


def yaw(angle: float) -> list[float]:
    return [math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]


def test_entries_are_interpolated_and_extrapolated():
    history = PoseHistory(reach=0.3)
    assert history.at(0) is None
    history.add(1_000_000_000, np.array([0.0, 0.0, 10.0, *yaw(0.0)]))
    history.add(2_000_000_000, np.array([4.0, 0.0, 12.0, *(-np.array(yaw(0.4)))]))  # the negative is the same rotation
    history.add(1_500_000_000, np.array([9.0, 9.0, 9.0, *yaw(2.0)]))  # too late
    middle = history.at(1_500_000_000)
    assert middle[:3] == pytest.approx([2.0, 0.0, 11.0])
    assert middle[3:] == pytest.approx(yaw(0.2))
    assert history.at(2_250_000_000)[0] == 4.0
    assert history.at(2_350_000_000) is None
    assert history.at(600_000_000) is None
    history.add(9_000_000_000, np.array([0.0, 0.0, 0.0, *yaw(0.0)]))
    assert history.at(1_500_000_000) is None  # removed by now
    history.clear()
    assert history.last is None


def test_entries_at_even_times_turn_the_short_way() -> None:
    history = PoseHistory()
    for k in range(4):
        history.add(k * 1_000_000_000, np.array([float(k), 0.0, 0.0, *((-1.0) ** k * np.array(yaw(0.1 * k)))]))
    found = history.during(500_000_000, 2.0, 4)
    assert found is not None
    assert found[:, 0] == pytest.approx([0.5, 1.0, 1.5, 2.0, 2.5])
    assert (np.einsum("ni,ni->n", found[1:, 3:], found[:-1, 3:]) > 0.99).all()
    assert history.during(2_500_000_000, 2.0, 4) is None


def test_both_orders_of_summation_give_a_unit_quaternion() -> None:
    for scalar_last in (False, True):
        history = PoseHistory(scalar_last=scalar_last)
        history.add(0, np.array(yaw(0.0)))
        history.add(10, np.array(yaw(1.0)))
        assert history.at(3) == pytest.approx(yaw(0.3), abs=0.02)
        assert np.linalg.norm(history.at(3)) == pytest.approx(1.0)
