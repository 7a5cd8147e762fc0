"""The followers of a swarm, and the state known to each: the complete state, or the part received over the network."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_coordination.batch import FollowerBatch
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.known_swarm_state import ArraySwarm, SwarmState
from xtdrone_coordination.network import Network
from xtdrone_swarm.swarm_vehicles import Array, Mask

Maker = Callable[..., Follower]
"""Factory of followers with the signature of the class ``Follower``: id, count, ``swarm=`` the state it reads."""


class FollowerGroup:
    """All followers of a swarm, computed together.

    Attributes:
        followers: followers of vehicles 1 to N-1.
        state: swarm state known to the leader.
        network: communication network between the vehicles; None if every vehicle knows the complete current state.
    """

    followers: Sequence[Follower]
    state: SwarmState

    def __init__(self, count: int, make: Maker, network: Network | None = None) -> None:
        """Create ``count`` - 1 followers."""
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
        """Begin a turn with all positions, m ENU, and velocities, m/s ENU, shape (N, 3) each."""
        self._hear(positions, velocities)

    def update(self) -> tuple[Array, Mask]:
        """Return the commands, shape (N, 3), and the mask of the commanded vehicles, shape (N,)."""
        return self._batch.update()

    def tick(self) -> None:
        """End a turn."""
        self.state.tick()

    def on_pattern(self, offsets: Array) -> None:
        """Assign all followers their slots relative to the leader, shape (N-1, 3), m ENU."""
        self._batch.on_pattern(offsets)

    def on_topology(self, adjacency: NDArray[np.int32]) -> None:
        """Pass the adjacency matrix, shape (N, N), to all followers."""
        self._batch.on_topology(adjacency)

    def restart(self) -> None:
        """Reset the known states and restart the network, which then repeats its random sequence."""
        self._batch.restart()
        if self.network is not None:
            self.network.restart()
