"""The communication topology: the adjacency matrix of the paper's section 5.

W[i, j] > 0 means that vehicle i uses the position of vehicle j. The paper derives its matrix for the six-vehicle T from
a "veteran rule"; the rule here reproduces that matrix: the neighbours of a vehicle are the two nearest vehicles with a
smaller number, where of equally near ones the one with the greater number counts as nearer. W is strictly lower
triangular, so the graph is acyclic with the leader at its root and the consensus law converges for any gain.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

NEIGHBOURS = 2
_SAME_DISTANCE = 1e-4  # m; offsets travel as float32
_BLOCK = 256  # rows at a time, so that memory is bounded


def veteran_topology(offsets: ArrayLike) -> NDArray[np.int32]:
    """Return the adjacency matrix W, shape (N, N), zeros and ones.

    Args:
        offsets: slots of all vehicles in order of their numbers, the leader's first, shape (N, 3), m.

    Raises:
        ValueError: another shape, or not finite.
    """
    points = np.asarray(offsets, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"topology: offsets have shape {points.shape}, must be (N, 3)")
    if not np.isfinite(points).all():
        raise ValueError("topology: offsets must be finite")
    count = len(points)
    adjacency = np.zeros((count, count), dtype=np.int32)
    for first in range(1, count, _BLOCK):
        rows = np.arange(first, min(first + _BLOCK, count))
        earlier = rows[-1]  # candidates of the block's last row; those not before a row are excluded below
        distance = np.linalg.norm(points[:earlier] - points[rows, None], axis=-1)
        steps = np.rint(distance / _SAME_DISTANCE)
        steps[np.arange(earlier) >= rows[:, None]] = np.inf
        for _ in range(NEIGHBOURS):
            nearest = earlier - 1 - np.argmin(steps[:, ::-1], axis=1)  # of equal ones the last
            found = steps[np.arange(len(rows)), nearest] < np.inf
            adjacency[rows[found], nearest[found]] = 1
            steps[np.arange(len(rows)), nearest] = np.inf
    return adjacency


def check_adjacency(values: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return an adjacency matrix of shape (count, count); the leader is added for followers without neighbours.

    Args:
        values: the matrix, or its N*N values row by row; not negative.
        count: number of vehicles N.

    Raises:
        ValueError: another size, a negative or not finite value, or a non-zero diagonal.
    """
    matrix = np.array(values, dtype=float)
    if matrix.size != count * count:
        raise ValueError(f"topology: {matrix.size} values, {count} vehicles need {count} x {count}")
    matrix = matrix.reshape(count, count)
    if not (matrix.min(initial=0.0) >= 0.0 and matrix.max(initial=0.0) < np.inf):
        raise ValueError("topology: weights must be finite and not negative")
    if matrix.diagonal().any():
        raise ValueError(f"topology: vehicle {int(np.argmax(matrix.diagonal() > 0))} listens to itself")
    matrix[without_neighbours(matrix), 0] = 1.0
    return matrix


def weights_of_row(row: NDArray[np.float64]) -> dict[int, float]:
    """Return the non-zero weights of a row of a checked adjacency matrix, by vehicle number."""
    columns = np.flatnonzero(row)
    return dict(zip(columns.tolist(), row[columns].tolist(), strict=True))


def without_neighbours(adjacency: ArrayLike) -> list[int]:
    """Return the followers with an empty row, ascending; :func:`check_adjacency` adds the leader to those rows.

    Args:
        adjacency: shape (N, N), or its values row by row, of a size that :func:`check_adjacency` accepts.
    """
    values = np.asarray(adjacency)
    rows = values.reshape(math.isqrt(values.size), -1)
    return [int(i) for i in np.flatnonzero(~rows.any(axis=1)) if i > 0]


def unreachable(adjacency: ArrayLike) -> list[int]:
    """Return the vehicles without a path from the leader, direct or through others, ascending.

    Args:
        adjacency: shape (N, N), as returned by :func:`check_adjacency`.
    """
    matrix = np.asarray(adjacency)
    listeners: list[list[int]] = [[] for _ in matrix]
    for i, j in zip(*(numbers.tolist() for numbers in np.nonzero(matrix)), strict=True):
        listeners[j].append(i)
    reached, waiting = {0}, [0]
    while waiting:
        new = [i for i in listeners[waiting.pop()] if i not in reached]
        reached.update(new)
        waiting += new
    return [i for i in range(len(matrix)) if i not in reached]
