"""The followers of a swarm, and what each of them knows: the whole state at once, or what its radio brings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xtdrone_coordination.batch import FollowerBatch
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.network import Network
from xtdrone_coordination.swarm import ArraySwarm, SwarmState
from xtdrone_swarm.swarm_vehicles import Array, Mask


class Maker(Protocol):
    """Makes a follower, as the class Follower does."""

    def __call__(self, id: int, count: int, *, swarm: SwarmState) -> Follower:
        """Return the follower of vehicle ``id``, which knows ``swarm``."""


class FollowerGroup:
    """All followers of a swarm, computed together.

    Attributes:
        followers: of vehicles 1 to N-1.
        state: what the leader knows.
        network: by which all hear each other, None when everybody knows the state of the turn.
    """

    followers: Sequence[Follower]
    state: SwarmState

    def __init__(self, count: int, make: Maker, network: Network | None = None) -> None:
        """Make ``count`` - 1 followers."""
        self.network = network
        if network is None:
            shared = ArraySwarm(count)
            self.state = shared
            self.followers = [make(i, count, swarm=shared) for i in range(1, count)]
            self._hear: Callable[[Array, Array], None] = shared.hear
            self._batch = FollowerBatch(self.followers, shared)
        else:
            self.state = network.known(0)
            self.followers = [make(i, count, swarm=network.known(i)) for i in range(1, count)]
            self._hear = network.step
            self._batch = FollowerBatch(self.followers, network=network)

    def hear(self, positions: Array, velocities: Array) -> None:
        """Begin a turn: take where all are, shape (N, 3) each, m and m/s ENU."""
        self._hear(positions, velocities)

    def update(self) -> tuple[Array, Mask]:
        """Return what to command, shape (N, 3), and whom, shape (N,)."""
        return self._batch.update()

    def tick(self) -> None:
        """End a turn."""
        self.state.tick()

    def on_pattern(self, offsets: Array) -> None:
        """Give all followers their slots, shape (N-1, 3), m ENU from the leader."""
        self._batch.on_pattern(offsets)

    def on_topology(self, adjacency: NDArray[np.int32]) -> None:
        """Give all followers the adjacency matrix, shape (N, N)."""
        self._batch.on_topology(adjacency)

    def restart(self) -> None:
        """Know nothing again, and let a network repeat what it did."""
        self._batch.restart()
        if self.network is not None:
            self.network.restart()
