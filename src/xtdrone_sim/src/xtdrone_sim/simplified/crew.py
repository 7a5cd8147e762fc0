"""The followers of a swarm, and what each of them knows: the whole state at once, or what its radio brings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xtdrone_coordination.batch import FollowerBatch
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.network import Network
from xtdrone_coordination.swarm import ArraySwarm, SwarmState

from .vehicles import Array, Mask


class Maker(Protocol):
    """Makes a follower, as the class Follower does."""

    def __call__(self, id: int, count: int, *, swarm: SwarmState) -> Follower:
        """Return the follower of vehicle ``id``, which knows ``swarm``."""


class Crew(Protocol):
    """All followers of a swarm."""

    @property
    def followers(self) -> Sequence[Follower]:
        """The followers, of vehicles 1 to N-1."""

    @property
    def state(self) -> SwarmState:
        """What the leader knows."""

    def hear(self, positions: Array, velocities: Array) -> None:
        """Begin a turn: take where all are, shape (N, 3) each, m and m/s ENU."""

    def update(self) -> tuple[Array, Mask]:
        """Return what to command, shape (N, 3), and whom, shape (N,)."""

    def tick(self) -> None:
        """End a turn."""

    def on_pattern(self, offsets: Array) -> None:
        """Give all followers their slots, shape (N-1, 3), m ENU from the leader."""

    def on_topology(self, adjacency: NDArray[np.int32]) -> None:
        """Give all followers the adjacency matrix, shape (N, N)."""

    def restart(self) -> None:
        """Know nothing again."""


class Together:
    """Followers that all know where everybody is: computed together. See :class:`Crew`."""

    def __init__(self, count: int, make: Maker) -> None:
        """Make ``count`` - 1 followers."""
        self.state = ArraySwarm(count)
        self.followers = [make(i, count, swarm=self.state) for i in range(1, count)]
        self._batch = FollowerBatch(self.followers, self.state)

    def hear(self, positions: Array, velocities: Array) -> None:
        """Begin a turn."""
        self.state.hear(positions, velocities)

    def update(self) -> tuple[Array, Mask]:
        """Return what to command, and whom."""
        return self._batch.update()

    def tick(self) -> None:
        """End a turn."""
        self.state.tick()

    def on_pattern(self, offsets: Array) -> None:
        """Give all followers their slots."""
        self._batch.on_pattern(offsets)

    def on_topology(self, adjacency: NDArray[np.int32]) -> None:
        """Give all followers the adjacency matrix."""
        self._batch.on_topology(adjacency)

    def restart(self) -> None:
        """Know nothing again."""
        self._batch.restart()


class Apart:
    """Followers that know what their radios bring: each by itself. See :class:`Crew`."""

    def __init__(self, network: Network, make: Maker) -> None:
        """Make the followers of a network's vehicles; vehicle 0 is the leader's."""
        self.network = network
        self.state = network.known(0)
        self.followers = [make(i, network.count, swarm=network.known(i)) for i in range(1, network.count)]
        self._commands = np.zeros((network.count, 3))
        self._given = np.zeros(network.count, dtype=bool)

    def hear(self, positions: Array, velocities: Array) -> None:
        """Begin a turn: everybody tells where it is."""
        self.network.step(positions, velocities)

    def update(self) -> tuple[Array, Mask]:
        """Return what to command, and whom."""
        for follower in self.followers:
            command = follower.update()
            self._given[follower.id] = command is not None
            if command is not None:
                self._commands[follower.id] = command
        return self._commands, self._given

    def tick(self) -> None:
        """Nothing is left to do: the network counts the turns."""

    def on_pattern(self, offsets: Array) -> None:
        """Give all followers their slots."""
        for follower in self.followers:
            follower.on_pattern(offsets)

    def on_topology(self, adjacency: NDArray[np.int32]) -> None:
        """Give all followers the adjacency matrix."""
        for follower in self.followers:
            follower.on_topology(adjacency)

    def restart(self) -> None:
        """Know nothing again."""
        self.network.restart()
        for follower in self.followers:
            follower.restart()
