"""Record of a swarm's flight: the positions at each turn and the leader's decisions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_swarm.swarm_vehicles import Array

_ROOM = 256  # turns allocated initially; doubled when full


@dataclass(frozen=True)
class Choice:
    """A pattern that the leader has chosen.

    Attributes:
        time: simulated time of the turn in which the leader announces the pattern, s.
        pattern: name of the pattern.
        offsets: assigned slots relative to the leader, shape (N-1, 3), m ENU.
        adjacency: communication topology, shape (N, N).
    """

    time: float
    pattern: str
    offsets: Array
    adjacency: NDArray[np.int32]


class Record:
    """A flight in memory: 24 bytes per vehicle and turn.

    Attributes:
        choices: patterns and topologies, in chronological order.
    """

    def __init__(self, count: int) -> None:
        """Create an empty record for ``count`` vehicles."""
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
        """Append a turn: its time, s, and a copy of the positions, shape (N, 3), m ENU."""
        if self._turns == len(self._times):
            self._times = np.concatenate([self._times, np.zeros_like(self._times)])
            self._positions = np.concatenate([self._positions, np.zeros_like(self._positions)])
        self._times[self._turns] = time
        self._positions[self._turns] = positions
        self._turns += 1
