"""State of the swarm as received at one place: the latest position and velocity of every vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xtdrone_coordination.laws.consensus import Vector

STATE_FIELDS = 6  # numbers of a vehicle in a message with the states of all: x, y, z, vx, vy, vz; m, m/s, ENU
NEVER = -1  # in ArraySwarm.heard and velocity_heard
_MAX_RUNS = 8  # of vehicle numbers in a message
_PLAIN = 1e300  # a sum of squares below it: all numbers are finite, and so are sums of them


class SwarmState:
    """Received positions and velocities; one object may serve all followers of a process.

    Time is counted in ticks of the control loop; no clock is read.

    Attributes:
        count: number of vehicles N.
        positions: m, ENU, in the frame all vehicles share; None before the first.
        velocities: m/s, ENU; None before the first.
        ticks: elapsed periods of the control loop.
    """

    def __init__(self, count: int) -> None:
        """Create an empty state of ``count`` vehicles."""
        self.count = count
        self.positions: list[Vector | None] = [None] * count
        self.velocities: list[Vector | None] = [None] * count
        self._heard = [0] * count
        self.ticks = 0

    def restart(self) -> None:
        """Reset to the initial state."""
        self.positions[:] = self.velocities[:] = [None] * self.count
        self._heard[:] = [0] * self.count
        self.ticks = 0

    def on_position(self, index: int, position: Vector) -> None:
        """Store a vehicle's position, m ENU; ignored unless finite."""
        if math.isfinite(position[0] + position[1] + position[2]):
            self.positions[index] = position
            self._heard[index] = self.ticks

    def on_velocity(self, index: int, velocity: Vector) -> None:
        """Store a vehicle's velocity, m/s ENU; ignored unless finite."""
        if math.isfinite(velocity[0] + velocity[1] + velocity[2]):
            self.velocities[index] = velocity

    def hear_states(self, numbers: Sequence[float]) -> None:
        """Store positions and velocities of all vehicles; those that are not finite are ignored.

        Args:
            numbers: x, y, z, vx, vy, vz of each vehicle in turn, m and m/s ENU; at least ``STATE_FIELDS * count``.
        """
        states = numbers[: STATE_FIELDS * self.count]
        positions = list(zip(states[0::STATE_FIELDS], states[1::STATE_FIELDS], states[2::STATE_FIELDS], strict=True))
        velocities = list(zip(states[3::STATE_FIELDS], states[4::STATE_FIELDS], states[5::STATE_FIELDS], strict=True))
        if math.isfinite(sum(states)):  # then each of them is
            self.positions[:] = positions
            self.velocities[:] = velocities
            self._heard[:] = [self.ticks] * self.count
            return
        for i, (position, velocity) in enumerate(zip(positions, velocities, strict=True)):
            self.on_position(i, position)
            self.on_velocity(i, velocity)

    def tick(self) -> None:
        """Count one period of the control loop; call it once per period, after all updates."""
        self.ticks += 1

    def fresh(self, index: int, ticks: int) -> bool:
        """Return whether a position of this vehicle was received in the last ``ticks`` ticks."""
        return self.positions[index] is not None and self.ticks - self._heard[index] <= ticks


class ArraySwarm(SwarmState):
    """State of the swarm in arrays, for a process that computes many followers together.

    ``positions`` and ``velocities`` are lists created from the arrays on demand, for reading only.

    Attributes:
        position_rows: m, ENU, shape (N, 3); zero while unknown.
        velocity_rows: m/s, ENU, shape (N, 3); zero while unknown.
        heard: tick of each position's reception, shape (N,); NEVER while unknown.
        velocity_heard: tick of each velocity's reception, shape (N,); NEVER while unknown.
        ticks: elapsed periods of the control loop.
    """

    def __init__(self, count: int) -> None:
        """Create an empty state of ``count`` vehicles."""
        self.count = count
        self.position_rows = np.zeros((count, 3))
        self.velocity_rows = np.zeros((count, 3))
        self.heard = np.full(count, NEVER, dtype=np.int64)
        self.velocity_heard = np.full(count, NEVER, dtype=np.int64)
        self.ticks = 0
        self._positions: list[Vector | None] | None = None
        self._velocities: list[Vector | None] | None = None

    @property
    def positions(self) -> list[Vector | None]:  # type: ignore[override]
        """Positions, m, ENU; None before the first."""
        if self._positions is None:
            self._positions = _known(self.position_rows, self.heard)
        return self._positions

    @property
    def velocities(self) -> list[Vector | None]:  # type: ignore[override]
        """Velocities, m/s, ENU; None before the first."""
        if self._velocities is None:
            self._velocities = _known(self.velocity_rows, self.velocity_heard)
        return self._velocities

    def hear(self, positions: ArrayLike, velocities: ArrayLike | None = None) -> None:
        """Store the positions (m, ENU) and velocities (m/s, ENU) of all vehicles, shape (N, 3) each.

        Rows that are not finite are ignored.
        """
        _store(positions, self.position_rows, self.heard, self.ticks)
        self._positions = None
        if velocities is not None:
            _store(velocities, self.velocity_rows, self.velocity_heard, self.ticks)
            self._velocities = None

    def hear_states(self, numbers: Sequence[float]) -> None:
        """Store positions and velocities of all vehicles, see :meth:`SwarmState.hear_states`."""
        rows = np.array(numbers[: STATE_FIELDS * self.count]).reshape(self.count, STATE_FIELDS)
        self.hear(rows[:, :3], rows[:, 3:])

    def on_position(self, index: int, position: Vector) -> None:
        """Store a vehicle's position, m ENU; ignored unless finite."""
        if math.isfinite(position[0] + position[1] + position[2]):
            self.position_rows[index] = position
            self.heard[index] = self.ticks
            self._positions = None

    def on_velocity(self, index: int, velocity: Vector) -> None:
        """Store a vehicle's velocity, m/s ENU; ignored unless finite."""
        if math.isfinite(velocity[0] + velocity[1] + velocity[2]):
            self.velocity_rows[index] = velocity
            self.velocity_heard[index] = self.ticks
            self._velocities = None

    def restart(self) -> None:
        """Reset to the initial state."""
        self.position_rows[:] = self.velocity_rows[:] = 0.0
        self.heard[:] = self.velocity_heard[:] = NEVER
        self.ticks = 0
        self._positions = self._velocities = None

    def tick(self) -> None:
        """Count one period of the control loop; call it once per period, after all updates."""
        self.ticks += 1

    def fresh(self, index: int, ticks: int) -> bool:
        """Return whether a position of this vehicle was received in the last ``ticks`` ticks."""
        heard = int(self.heard[index])
        return heard != NEVER and self.ticks - heard <= ticks


def _store(values: ArrayLike, into: NDArray[np.float64], heard: NDArray[np.int64], tick: int) -> None:
    """Copy the finite ones of N rows and record the tick for them."""
    rows = np.asarray(values, dtype=float)
    if rows.shape != into.shape:
        raise ValueError(f"swarm: states have shape {rows.shape}, must be {into.shape}")
    if np.vdot(rows, rows) < _PLAIN:
        into[:] = rows
        heard[:] = tick
        return
    finite = np.isfinite(rows[:, 0] + rows[:, 1] + rows[:, 2])
    into[finite] = rows[finite]
    heard[finite] = tick


def _known(rows: NDArray[np.float64], heard: NDArray[np.int64]) -> list[Vector | None]:
    return [(x, y, z) if at != NEVER else None for (x, y, z), at in zip(rows.tolist(), heard.tolist(), strict=True)]


def as_vector(value: Any) -> Vector | None:
    """Return ``value`` (a tuple, list or array) as three finite floats, else None."""
    try:
        x, y, z = value
        x, y, z = float(x), float(y), float(z)
    except (TypeError, ValueError):
        return None
    return (x, y, z) if math.isfinite(x) and math.isfinite(y) and math.isfinite(z) else None


def number_list(numbers: Sequence[int]) -> str:
    """Return ascending vehicle numbers as a short text of ranges; of many ranges, the first few and a count."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1] = [runs[-1][0], number]
        else:
            runs.append([number])
    text = ", ".join("-".join(str(n) for n in run) for run in runs[:_MAX_RUNS])
    return text if len(runs) <= _MAX_RUNS else f"{text}, ... ({len(numbers)} in total)"
