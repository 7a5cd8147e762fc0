"""A follower whose law is written in arrays, for thousands of vehicles in one process.

::

    class Damped(ArrayFollower):
        @classmethod
        def control_laws(cls, options, own, peers):
            return own.stock + 0.2 * (peers.mean(peers.velocity) - own.velocity)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xtdrone_coordination.follower import Follower, FollowerOptions
from xtdrone_coordination.laws.consensus import Peer, Vector

_FORMS = {"control_law", "control_laws"}


@dataclass(frozen=True)
class OwnRows:
    """M followers, one row each: the inputs of a law that concern the follower itself.

    Attributes:
        ids: their numbers, shape (M,).
        position: shape (M, 3), m ENU.
        velocity: shape (M, 3), m/s ENU; zero while unknown.
        offset: their slots relative to the leader, shape (M, 3), m ENU.
        stock: results of the stock law, shape (M, 3), m/s or m/s^2 ENU.
    """

    ids: NDArray[np.int64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    offset: NDArray[np.float64]
    stock: NDArray[np.float64]


@dataclass(frozen=True)
class PeerRows:
    """E links from the M followers to their neighbours, grouped by follower, at least one for each.

    Attributes:
        row: index (0 to M-1) of the follower of each link, shape (E,).
        ids: numbers of the neighbours, shape (E,).
        weight: w_ij, shape (E,).
        position: the neighbour's position as the follower knows it, shape (E, 3), m ENU.
        velocity: shape (E, 3), m/s ENU; zero while unknown.
        offset: the neighbour's slot relative to the leader, shape (E, 3), m ENU.
    """

    row: NDArray[np.int64]
    ids: NDArray[np.int64]
    weight: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    offset: NDArray[np.float64]

    def sum(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return the sum of ``values``, shape (E, 3), over the neighbours of each follower, shape (M, 3), in order."""
        columns = np.asarray(values, dtype=float).T
        return np.stack([np.bincount(self.row, weights=column) for column in columns], axis=1)

    def mean(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return the mean of ``values``, shape (E, 3), over the neighbours of each follower, shape (M, 3)."""
        return self.sum(values) / np.bincount(self.row)[:, None]


class ArrayFollower(Follower):
    """A follower with its law in arrays: override :meth:`control_laws`.

    The array form is called once for all followers of one class and equal options that are computed together, and with
    a single row otherwise. A class that defines ``control_law`` beside it uses that one for a follower computed alone;
    the two must agree. A subclass that defines ``control_law`` alone replaces both.
    """

    @classmethod
    def control_laws(cls, options: FollowerOptions, own: OwnRows, peers: PeerRows) -> ArrayLike:
        """Return the results of the law for M followers; the default is the stock law.

        Args:
            options: settings, common to all these followers.
            own: the followers, M rows.
            peers: their neighbours with known, recent positions.

        Returns:
            Shape (M, 3), m/s or m/s^2 ENU, before avoidance and limits.
        """
        return own.stock

    @property
    def law_forms(self) -> set[str]:
        """The forms of the law, ``control_law`` or ``control_laws`` or both, with the highest precedence.

        A ``control_law`` assigned to this object comes first, then the most derived class that defines either.
        """
        if "control_law" in vars(self):
            return {"control_law"}
        return next(found for base in type(self).__mro__ if (found := _FORMS & vars(base).keys()))

    def evaluate_law(self, position: Vector, peers: Sequence[Peer]) -> Vector:
        """Return the checked result of the law for this follower alone."""
        if "control_law" in self.law_forms:
            return super().evaluate_law(position, peers)
        result = self.control_laws(self.options, self._own_row(position, peers), self._peer_rows(peers))
        rows = as_rows(result, 1)
        return self.checked_vector(result if rows is None else tuple(rows[0].tolist()), "control_laws")

    def _own_row(self, position: Vector, peers: Sequence[Peer]) -> OwnRows:
        assert self.offsets is not None
        return OwnRows(
            ids=np.array([self.id]),
            position=np.array([position]),
            velocity=np.array([self.swarm.velocities[self.id] or (0.0, 0.0, 0.0)]),
            offset=np.array([self.offsets[self.id]]),
            stock=np.array([Follower.control_law(self, position, peers)]),
        )

    def _peer_rows(self, peers: Sequence[Peer]) -> PeerRows:
        ids, weights, positions, velocities, offsets = zip(*peers, strict=True)
        return PeerRows(
            row=np.zeros(len(peers), dtype=np.int64),
            ids=np.array(ids),
            weight=np.array(weights, dtype=float),
            position=np.array(positions),
            velocity=np.array(velocities),
            offset=np.array(offsets),
        )


def as_rows(value: ArrayLike, count: int) -> NDArray[np.float64] | None:
    """Return ``value`` as an array of shape (count, 3), None if its shape or type differs."""
    try:
        rows = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return rows if rows.shape == (count, 3) else None
