"""Who listens to whom: the adjacency matrix of the paper's section 5.

W[i, j] > 0 means that vehicle i uses the position of vehicle j. The paper takes its matrix for the six-vehicle T from
a "veteran rule"; the rule here reproduces that matrix: each vehicle listens to the two nearest among those that come
before it in number, where of equally near ones the later counts as nearer. W is strictly lower triangular, so the
graph is acyclic with the leader at its root and the consensus law converges whatever the gains.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

NEIGHBOURS = 2
_SAME_DISTANCE = 1e-4  # m; offsets travel as float32


def veteran_topology(offsets: ArrayLike) -> NDArray[np.int32]:
    """Return the adjacency matrix W, shape (N, N), zeros and ones.

    Args:
        offsets: slots of all vehicles in order of their numbers, the leader's first, shape (N, 3), m.

    Raises:
        ValueError: another shape.
    """
    points = np.asarray(offsets, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"topology: offsets have shape {points.shape}, must be (N, 3)")
    count = len(points)
    adjacency = np.zeros((count, count), dtype=np.int32)
    for i in range(1, count):
        distance = np.linalg.norm(points[:i] - points[i], axis=1)
        nearest = sorted(range(i), key=lambda j: (round(distance[j] / _SAME_DISTANCE), -j))
        adjacency[i, nearest[:NEIGHBOURS]] = 1
    return adjacency


def check_adjacency(values: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return an adjacency matrix of shape (count, count); a follower that listens to nobody gets the leader.

    Args:
        values: the matrix, or its N*N values row by row; not negative.
        count: number of vehicles N.

    Raises:
        ValueError: another size, a negative or not finite value, or a vehicle that listens to itself.
    """
    matrix = np.array(values, dtype=float)
    if matrix.size != count * count:
        raise ValueError(f"topology: {matrix.size} values, {count} vehicles need {count} x {count}")
    matrix = matrix.reshape(count, count)
    if not np.isfinite(matrix).all() or (matrix < 0.0).any():
        raise ValueError("topology: weights must be finite and not negative")
    if matrix.diagonal().any():
        raise ValueError(f"topology: vehicle {int(np.argmax(matrix.diagonal() > 0))} listens to itself")
    deaf = ~matrix.any(axis=1)
    deaf[0] = False
    matrix[deaf, 0] = 1.0
    return matrix
