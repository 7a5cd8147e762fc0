"""The interface between a swarm's algorithms and its vehicles, simplified or in full physics; records of flights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

HOLD, VELOCITY, ACCELERATION, POSITION = 0, 1, 2, 3
"""Kinds of a setpoint: stay where it is now; m/s ENU; m/s^2 ENU; m ENU."""


class Vehicles(Protocol):
    """N vehicles, ordered by number. All arrays are ENU in the ``map`` frame, and read-only for callers.

    Attributes:
        names: names of the vehicles, for example ``iris_0``.
        time_us: simulated time, microseconds; a multiple of ``step_us``.
        step_us: base step, microseconds.
        position: estimated positions, shape (N, 3), m; the true ones in the simplified models.
        velocity: estimated velocities, shape (N, 3), m/s.
        yaw: heading, rad counter-clockwise from east, shape (N,).
        true_position: true positions, shape (N, 3), m.
        armed: whether each vehicle is armed.
        mode: PX4 mode of each vehicle, as MAVROS names it.
    """

    names: tuple[str, ...]
    time_us: int
    step_us: int
    position: Array
    velocity: Array
    yaw: Array
    true_position: Array
    armed: Sequence[bool]
    mode: Sequence[str]

    def command(self, index: int, text: str) -> str:
        """Send an XTDrone command to a vehicle: ARM, DISARM, HOVER or a PX4 mode such as OFFBOARD or AUTO.LAND.

        Returns:
            The reason for a rejection; "" if the command is accepted.
        """

    def steer(self, kind: int, vectors: Array, given: Mask) -> None:
        """Set the setpoints of some vehicles; in OFFBOARD they act until the next ones, and the heading is kept.

        Args:
            kind: VELOCITY or ACCELERATION (POSITION if the vehicles support it).
            vectors: shape (N, 3), ENU.
            given: mask of the rows to apply, shape (N,).
        """

    def steer_one(self, index: int, kind: int, vector: tuple[float, float, float], yaw_rate: float = 0.0) -> None:
        """Set one vehicle's setpoint, ENU, with a yaw rate, rad/s."""

    def advance(self, time_us: int) -> None:
        """Advance to ``time_us``, a multiple of ``step_us``."""

    def restart(self) -> None:
        """Reset vehicles and time to the start; equal inputs then reproduce the flight bit for bit."""

    def close(self) -> None:
        """Release all resources."""


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


class FlightRecord:
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
