"""What a law reads that is computed for many followers at once: rows of arrays not one position and its peers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class OwnRows:
    """M followers, each with what it knows of itself.

    Attributes:
        ids: their numbers, shape (M,).
        position: shape (M, 3), m ENU.
        velocity: shape (M, 3), m/s ENU; zero while unknown.
        offset: their slots relative to the leader, shape (M, 3), m ENU.
        stock: what the stock law gives, shape (M, 3), m/s or m/s^2 ENU.
    """

    ids: NDArray[np.int64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    offset: NDArray[np.float64]
    stock: NDArray[np.float64]


@dataclass(frozen=True)
class PeerRows:
    """E links: those that the M followers listen to, one follower's after the other's, at least one for each.

    Attributes:
        row: which of the M followers it is that listens, shape (E,).
        ids: numbers of the others, shape (E,).
        weight: w_ij, shape (E,).
        position: where the listener knows the other to be, shape (E, 3), m ENU.
        velocity: shape (E, 3), m/s ENU; zero while unknown.
        offset: the other's slot relative to the leader, shape (E, 3), m ENU.
    """

    row: NDArray[np.int64]
    ids: NDArray[np.int64]
    weight: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    offset: NDArray[np.float64]

    def sum(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return the sums over each follower's peers, shape (M, 3), of values of shape (E, 3), in their order."""
        columns = np.asarray(values, dtype=float).T
        return np.stack([np.bincount(self.row, weights=column) for column in columns], axis=1)

    def mean(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return the means over each follower's peers, shape (M, 3), of values of shape (E, 3)."""
        return self.sum(values) / np.bincount(self.row)[:, None]
