"""What a swarm's flight was: where all were at each turn, and what the leader decided when."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_swarm.swarm_vehicles import Array

_ROOM = 256  # turns at first; doubled when it is full


@dataclass(frozen=True)
class Choice:
    """A pattern that the leader has chosen.

    Attributes:
        time: s, of the turn in which the leader says it.
        pattern: its name.
        offsets: assigned slots, shape (N-1, 3), m ENU from the leader.
        adjacency: topology, shape (N, N).
    """

    time: float
    pattern: str
    offsets: Array
    adjacency: NDArray[np.int32]


class Record:
    """A flight in memory: 24 bytes a vehicle and turn.

    Attributes:
        choices: patterns and topologies in order of time.
    """

    def __init__(self, count: int) -> None:
        """Begin with nothing, for ``count`` vehicles."""
        self.choices: list[Choice] = []
        self._times = np.zeros(_ROOM)
        self._positions = np.zeros((_ROOM, count, 3))
        self._turns = 0

    @property
    def times(self) -> Array:
        """Simulated time of each turn, shape (T,), s."""
        return self._times[: self._turns]

    @property
    def positions(self) -> Array:
        """True positions at these times, shape (T, N, 3), m ENU."""
        return self._positions[: self._turns]

    def add(self, time: float, positions: Array) -> None:
        """Take a turn's time, s, and positions, shape (N, 3); they are copied."""
        if self._turns == len(self._times):
            self._times = np.concatenate([self._times, np.zeros_like(self._times)])
            self._positions = np.concatenate([self._positions, np.zeros_like(self._positions)])
        self._times[self._turns] = time
        self._positions[self._turns] = positions
        self._turns += 1
