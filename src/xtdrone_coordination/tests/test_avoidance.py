"""Algorithm 1 (avoidance) and the functions around it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_coordination.laws.formation_avoidance import avoid, contribution, give_way


def vectors() -> list[tuple[float, float, float]]:
    """Return many vectors within the radius, special cases first."""
    units = [(s * x, s * y, s * z) for s in (1.0, -1.0) for x, y, z in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0))]
    awkward = [*units, (1e-7, 0.0, 0.0), (0.0, 0.0, 1e-9), (0.3, -0.3, 0.0)]
    return awkward + [tuple(v) for v in np.random.default_rng(5).uniform(-0.8, 0.8, (200, 3)).tolist()]


@pytest.mark.parametrize("r", vectors())
def test_is_finite_perpendicular_antisymmetric_and_of_the_papers_size(r: tuple[float, float, float]) -> None:
    a = contribution(r, 1.5, 2.0, first=True)
    b = contribution(tuple(-x for x in r), 1.5, 2.0, first=False)
    distance = math.sqrt(sum(x * x for x in r))
    assert np.isfinite(a).all()
    assert np.dot(a, r) == pytest.approx(0.0, abs=1e-6)
    assert b == pytest.approx([-x for x in a])
    assert np.linalg.norm(a) == pytest.approx(2.0 * (1 - distance / 1.5))


def test_is_the_papers_cross_product() -> None:
    r = np.array([0.2, 0.9, -0.4])  # smaller along x, so n = x
    expected = (1 - np.linalg.norm(r) / 1.5) * np.cross(r, [1, 0, 0]) / np.linalg.norm(np.cross(r, [1, 0, 0]))
    assert contribution(tuple(r)) == pytest.approx(expected)
    r = np.array([-1.0, 0.0, 0.0])  # here the paper's signed test divides 0 by 0
    assert contribution(tuple(r)) == pytest.approx((1 - 1 / 1.5) * np.cross(r, [0, 1, 0]))


def test_ends_at_the_radius() -> None:
    assert contribution((1.5, 0.0, 0.0)) == (0.0, 0.0, 0.0)
    assert np.linalg.norm(contribution((1.4999, 0.0, 0.0))) < 1e-3


def test_coincident_vehicles_part() -> None:
    here = (1.0, 2.0, 3.0)
    a, b = avoid(0, [here, here]), avoid(1, [here, here])
    assert np.linalg.norm(a) == pytest.approx(1.0)
    assert b == pytest.approx([-x for x in a])


def test_sums_over_those_near_and_ignores_the_unknown() -> None:
    positions = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), None, (0.0, 0.5, 0.0), (9.0, 0.0, 0.0)]
    expected = np.add(contribution((1.0, 0.0, 0.0)), contribution((0.0, 0.5, 0.0)))
    assert avoid(0, positions) == pytest.approx(expected)
    assert avoid(2, positions) == (0.0, 0.0, 0.0)


def test_giving_way_removes_only_the_closing_component() -> None:
    other = [(0.0, 0.0, 0.0), (1.1, 0.0, 0.0)]
    # half of the correction remains: a quarter in each of the two rounds
    assert give_way(0, other, (1.0, 0.5, 0.0), 1.5, 0.7) == pytest.approx((1.0 / 16.0, 0.5, 0.0))
    assert give_way(0, other, (-1.0, 0.5, 0.0), 1.5, 0.7) == (-1.0, 0.5, 0.0)
    assert give_way(0, [(0.0, 0.0, 0.0), (0.6, 0.0, 0.0)], (1.0, 0.5, 0.0), 1.5, 0.7) == pytest.approx((0, 0.5, 0))
    assert give_way(0, [(0.0, 0.0, 0.0), (1.6, 0.0, 0.0)], (1.0, 0.5, 0.0), 1.5, 0.7) == (1.0, 0.5, 0.0)
    assert give_way(0, other, (1.0, 0.5, 0.0), 1.5, 0.0) == (1.0, 0.5, 0.0), "clearance 0 is the paper alone"


def test_giving_way_to_one_vehicle_does_not_approach_another() -> None:
    """With two neighbours side by side, giving way to the first must not turn the velocity towards the second."""
    positions = [(0.0, 0.0, 0.0), (0.6, 0.2, 0.0), (0.6, -0.2, 0.0)]
    velocity = give_way(0, positions, (1.0, 0.0, 0.0), 1.5, 0.7)
    for other in positions[1:]:
        assert np.dot(velocity, other) < 0.1 * np.linalg.norm(other)
