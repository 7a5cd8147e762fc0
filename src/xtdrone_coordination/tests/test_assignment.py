"""Assignment of slots."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from xtdrone_coordination.assignment import assign
from xtdrone_coordination.patterns import Patterns


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6])
def test_is_the_best_of_all_permutations(size: int) -> None:
    rng = np.random.default_rng(size)
    for _ in range(5):
        here, there = rng.uniform(-5, 5, (2, size, 3))
        best = min(
            np.linalg.norm(here - there[list(order)], axis=1).sum() for order in itertools.permutations(range(size))
        )
        solved = assign(here, there)
        assert solved.cost == pytest.approx(best)
        assert np.linalg.norm(here - there[solved.slots], axis=1).sum() == pytest.approx(best), "direction of slots"


def test_known_cases() -> None:
    six, nine = Patterns(6), Patterns(9)
    assert assign(six.offsets("origin"), six.offsets("T")).cost == pytest.approx(24.28, abs=0.01)
    assert assign(nine.offsets("pyramid"), nine.offsets("cube")).cost == pytest.approx(26.5, abs=0.05)


def test_who_is_there_already_stays() -> None:
    cube = Patterns(9).offsets("cube")
    order = np.random.default_rng(1).permutation(8)
    solved = assign(cube[order], cube)
    assert solved.cost == 0.0
    assert solved.slots.tolist() == order.tolist()


@pytest.mark.parametrize(
    ("here", "there"), [(np.zeros((2, 3)), np.zeros((3, 3))), (np.zeros(3), np.zeros(3)), (np.zeros((2, 2)),) * 2]
)
def test_shapes_are_checked(here: np.ndarray, there: np.ndarray) -> None:
    with pytest.raises(ValueError, match="shapes"):
        assign(here, there)


def test_nan_is_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        assign([[np.nan, 0, 0]], [[0, 0, 0]])
