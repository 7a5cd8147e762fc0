"""Communication topology."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_coordination.patterns import Patterns, with_leader
from xtdrone_coordination.topology import check_adjacency, veteran_topology

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


def test_who_listens_to_nobody_gets_the_leader() -> None:
    matrix = check_adjacency([0, 0, 0, 0, 0, 0, 0, 2, 0], 3)
    assert matrix.tolist() == [[0, 0, 0], [1, 0, 0], [0, 2, 0]]


@pytest.mark.parametrize(
    ("values", "message"),
    [([0, 1], "2 x 2"), ([0, 0, -1, 0], "negative"), ([0, 0, np.nan, 0], "finite"), ([0, 0, 1, 1], "itself")],
)
def test_bad_matrices(values: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_adjacency(values, 2)
