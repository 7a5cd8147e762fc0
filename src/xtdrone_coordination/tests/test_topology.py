"""Communication topology."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_coordination.laws.topology import check_adjacency, unreachable, veteran_topology
from xtdrone_coordination.patterns import Patterns, with_leader

PAPER = [
    [0, 0, 0, 0, 0, 0],
    [1, 0, 0, 0, 0, 0],
    [1, 1, 0, 0, 0, 0],
    [0, 1, 1, 0, 0, 0],
    [0, 0, 1, 1, 0, 0],
    [0, 0, 0, 1, 1, 0],
]


@pytest.mark.parametrize("name", ["T", "origin"])
def test_the_papers_matrix(name: str) -> None:
    assert veteran_topology(with_leader(Patterns(6).offsets(name))).tolist() == PAPER


@pytest.mark.parametrize("count", [2, 6, 9, 18, 30])
def test_is_acyclic_and_rooted_at_the_leader(count: int) -> None:
    patterns = Patterns(count)
    rng = np.random.default_rng(count)
    for name in patterns.names:
        offsets = patterns.offsets(name)[rng.permutation(count - 1)]
        matrix = veteran_topology(with_leader(offsets))
        assert matrix.dtype.kind == "i"
        assert not np.triu(matrix).any()
        assert matrix.sum(axis=1).tolist() == [min(i, 2) for i in range(count)]


def test_rounding_of_float32_does_not_change_it() -> None:
    offsets = with_leader(Patterns(18).offsets("sphere"))
    narrow = offsets.astype(np.float32).astype(float)
    assert (veteran_topology(offsets) == veteran_topology(narrow)).all()


def veterans_one_by_one(offsets: np.ndarray) -> np.ndarray:
    """Apply the published rule: the two nearest of the preceding vehicles; of equally near ones the later."""
    adjacency = np.zeros((len(offsets),) * 2, dtype=int)
    for i in range(1, len(offsets)):
        distance = np.linalg.norm(offsets[:i] - offsets[i], axis=1)
        adjacency[i, sorted(range(i), key=lambda j: (round(distance[j] / 1e-4), -j))[:2]] = 1
    return adjacency


@pytest.mark.parametrize("count", [1, 2, 3, 256, 257, 258, 600])
def test_many_at_once_follow_the_same_rule(count: int) -> None:
    rng = np.random.default_rng(count)
    lattice = rng.integers(0, 7, (count, 3)) * 3.0  # many at the same distance
    for offsets in (lattice, lattice + rng.normal(scale=1e-4, size=(count, 3)), rng.normal(size=(count, 3))):
        assert (veteran_topology(offsets) == veterans_one_by_one(offsets)).all()


def test_offsets_that_are_not_finite() -> None:
    with pytest.raises(ValueError, match="finite"):
        veteran_topology([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])


def test_followers_without_the_leaders_state() -> None:
    chain = np.eye(5, k=-1)
    assert unreachable(chain) == []
    chain[2, 1], chain[2, 3] = 0, 1  # 2 and 3 listen to each other alone
    assert unreachable(chain) == [2, 3, 4]
    assert unreachable([[0, 1], [0, 0]]) == [1], "that the leader listens to it does not help"
    assert unreachable(np.zeros((3, 3))) == [1, 2]
    assert unreachable(np.eye(1000, k=-1)) == []


@settings(max_examples=50, deadline=None, derandomize=True)
@given(count=st.integers(1, 12), seed=st.integers(0, 2**31), density=st.floats(0.0, 0.4))
def test_unreachable_vehicles_have_no_path_of_any_length(count: int, seed: int, density: float) -> None:
    links = np.random.default_rng(seed).random((count, count)) < density
    np.fill_diagonal(links, False)
    hears = np.linalg.matrix_power(links.astype(int) + np.eye(count, dtype=int), count) > 0
    assert unreachable(links) == np.flatnonzero(~hears[:, 0]).tolist()


def test_a_follower_without_neighbours_gets_the_leader() -> None:
    matrix = check_adjacency([0, 0, 0, 0, 0, 0, 0, 2, 0], 3)
    assert matrix.tolist() == [[0, 0, 0], [1, 0, 0], [0, 2, 0]]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([0, 1], "2 x 2"),
        ([0, 0, -1, 0], "negative"),
        ([0, 0, np.nan, 0], "finite"),
        ([0, 0, np.inf, 0], "finite"),
        ([0, 0, 1, 1], "itself"),
    ],
)
def test_bad_matrices(values: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_adjacency(values, 2)
