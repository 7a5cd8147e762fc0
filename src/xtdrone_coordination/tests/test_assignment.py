"""Assignment of slots."""

from __future__ import annotations

import itertools
import tracemalloc

import numpy as np
import pytest

from xtdrone_coordination.leader import assign
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


def test_an_existing_node_keeps_its_name() -> None:
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


def test_nan_is_rejected() -> None:
    with pytest.raises(ValueError, match="finite"):
        assign([[np.nan, 0, 0]], [[0, 0, 0]])


def reduced_costs(here: np.ndarray, there: np.ndarray, slots: np.ndarray) -> np.ndarray:
    """Return the loss of each follower in each slot at the slots' prices, shape (M, M).

    The prices are shortest paths in the graph in which a follower leaves its slot for another (Bellman and Ford).
    None less than zero proves that no other assignment is better: any other's cost is this one's plus the sum of those
    that it uses. If the prices do not converge, a ring of followers gains by passing slots on.
    """
    distance = np.linalg.norm(here[:, None] - there[None], axis=-1)
    loss = distance - distance[np.arange(len(slots)), slots][:, None]
    prices = np.zeros(len(slots))
    for _ in range(len(slots)):
        better = np.minimum(prices, (prices[slots][:, None] + loss).min(axis=0))
        if np.array_equal(better, prices):
            break
        prices = better
    return loss + prices[slots][:, None] - prices


@pytest.mark.parametrize(("before", "after"), [("origin", "cube"), ("sphere", "text:XTD"), ("pyramid", "grid")])
def test_a_thousand_are_assigned_in_the_best_way(before: str, after: str) -> None:
    patterns = Patterns(1000)
    here, there = patterns.offsets(before), patterns.offsets(after)
    here += np.random.default_rng(5).normal(0.0, 0.05, here.shape)
    solved = assign(here, there)
    assert sorted(solved.slots.tolist()) == list(range(999))
    assert solved.cost == pytest.approx(np.linalg.norm(here - there[solved.slots], axis=1).sum(), rel=1e-12)
    assert reduced_costs(here, there, solved.slots).min() > -1e-9


def test_the_proof_of_optimality_detects_other_assignments() -> None:
    patterns = Patterns(300)
    here, there = patterns.offsets("origin"), patterns.offsets("sphere")
    slots = assign(here, there).slots.copy()
    assert reduced_costs(here, there, slots).min() > -1e-9
    slots[[0, 200]] = slots[[200, 0]]
    assert reduced_costs(here, there, slots).min() < -1e-3


def test_memory_of_a_large_assignment() -> None:
    patterns = Patterns(1000)
    here, there = patterns.offsets("origin"), patterns.offsets("sphere")
    tracemalloc.start()
    assign(here, there)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40e6, "three matrices of 8 MB and small change"
