"""Assignment of slots to followers with the minimum total distance (Kuhn-Munkres, section 5 of the paper)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

_LARGE = 200  # followers; smaller problems are passed to the solver unchanged, so that ties are resolved as before


@dataclass(frozen=True)
class Assignment:
    """A solved assignment.

    Attributes:
        slots: shape (M,); follower i (row i of ``current``) flies to ``target[slots[i]]``.
        cost: total straight-line distance, m.
    """

    slots: NDArray[np.intp]
    cost: float


def assign(current: ArrayLike, target: ArrayLike) -> Assignment:
    """Return the assignment of minimum total Euclidean distance.

    Args:
        current: positions of the followers, shape (M, 3), m.
        target: the slots in the same frame, shape (M, 3), m.

    Raises:
        ValueError: shapes differ or are not (M, 3), or a value is not finite.
    """
    here, there = np.asarray(current, dtype=float), np.asarray(target, dtype=float)
    if here.ndim != 2 or here.shape[1] != 3 or here.shape != there.shape:
        raise ValueError(f"assignment: shapes {here.shape} and {there.shape}, both must be (M, 3)")
    if not (np.isfinite(here).all() and np.isfinite(there).all()):
        raise ValueError("assignment: all positions must be finite")
    distance = _distances(here, there)
    rows, columns = linear_sum_assignment(distance if len(here) < _LARGE else _reduced(distance))
    return Assignment(columns, float(distance[rows, columns].sum()))


def _distances(here: NDArray[np.float64], there: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances of all pairs, shape (M, M)."""
    if len(here) < _LARGE:
        return np.asarray(np.linalg.norm(here[:, None] - there[None], axis=-1))
    squares = np.zeros((len(here), len(there)))
    for a, b in zip(here.T, there.T, strict=True):  # one axis at a time, for a third of the memory
        difference = a[:, None] - b
        difference *= difference
        squares += difference
    return np.sqrt(squares, out=squares)


def _reduced(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances minus the least of each row, then of each column; the optimal assignments stay the same.

    The solver starts without dual prices and is faster with zeros to assign.
    """
    reduced = distance - distance.min(axis=1, keepdims=True)
    reduced -= reduced.min(axis=0)
    return reduced
