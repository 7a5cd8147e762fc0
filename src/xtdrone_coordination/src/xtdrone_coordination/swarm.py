"""What is known of the swarm at one place: the latest position and velocity of every vehicle."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xtdrone_coordination.consensus import Vector

NEVER = -1  # in ArraySwarm.heard and velocity_heard
_PLAIN = 1e300  # a sum of squares below it: all numbers are finite, and so are sums of them


class SwarmState:
    """Positions and velocities as they come in; one object may serve all followers of a process.

    Time is counted in ticks of the control loop, so nothing here reads a clock.

    Attributes:
        count: number of vehicles N.
        positions: m, ENU, in the frame all share; None until heard of.
        velocities: m/s, ENU; None until heard of.
        ticks: periods of the control loop so far.
    """

    def __init__(self, count: int) -> None:
        """Know nothing yet of ``count`` vehicles."""
        self.count = count
        self.positions: list[Vector | None] = [None] * count
        self.velocities: list[Vector | None] = [None] * count
        self._heard = [0] * count
        self.ticks = 0

    def restart(self) -> None:
        """Know nothing again, as after construction."""
        self.positions[:] = self.velocities[:] = [None] * self.count
        self._heard[:] = [0] * self.count
        self.ticks = 0

    def on_position(self, index: int, position: Vector) -> None:
        """Take a vehicle's position, m ENU; one that is not finite is as if it had not come."""
        if math.isfinite(position[0] + position[1] + position[2]):
            self.positions[index] = position
            self._heard[index] = self.ticks

    def on_velocity(self, index: int, velocity: Vector) -> None:
        """Take a vehicle's velocity, m/s ENU; one that is not finite is as if it had not come."""
        if math.isfinite(velocity[0] + velocity[1] + velocity[2]):
            self.velocities[index] = velocity

    def tick(self) -> None:
        """Count one period of the control loop; call it once per period, after everything has been updated."""
        self.ticks += 1

    def fresh(self, index: int, ticks: int) -> bool:
        """Return whether a position of this vehicle came in the last ``ticks`` ticks."""
        return self.positions[index] is not None and self.ticks - self._heard[index] <= ticks


class ArraySwarm(SwarmState):
    """A swarm's state kept in arrays, so that a process can hear of all vehicles and compute all followers at once.

    ``positions`` and ``velocities`` are lists made of the arrays when somebody asks; they are for reading.

    Attributes:
        position_rows: m, ENU, shape (N, 3); zero while unknown.
        velocity_rows: m/s, ENU, shape (N, 3); zero while unknown.
        heard: tick of each position, shape (N,); NEVER while unknown.
        velocity_heard: tick of each velocity, shape (N,); NEVER while unknown.
        ticks: periods of the control loop so far.
    """

    def __init__(self, count: int) -> None:
        """Know nothing yet of ``count`` vehicles."""
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
        """Positions, m, ENU; None until heard of."""
        if self._positions is None:
            self._positions = _known(self.position_rows, self.heard)
        return self._positions

    @property
    def velocities(self) -> list[Vector | None]:  # type: ignore[override]
        """Velocities, m/s, ENU; None until heard of."""
        if self._velocities is None:
            self._velocities = _known(self.velocity_rows, self.velocity_heard)
        return self._velocities

    def hear(self, positions: ArrayLike, velocities: ArrayLike | None = None) -> None:
        """Take the positions (m, ENU) and velocities (m/s, ENU) of all vehicles, shape (N, 3) each.

        A vehicle's row that is not finite is as if it had not come.
        """
        _take(positions, self.position_rows, self.heard, self.ticks)
        self._positions = None
        if velocities is not None:
            _take(velocities, self.velocity_rows, self.velocity_heard, self.ticks)
            self._velocities = None

    def on_position(self, index: int, position: Vector) -> None:
        """Take a vehicle's position, m ENU; one that is not finite is as if it had not come."""
        if math.isfinite(position[0] + position[1] + position[2]):
            self.position_rows[index] = position
            self.heard[index] = self.ticks
            self._positions = None

    def on_velocity(self, index: int, velocity: Vector) -> None:
        """Take a vehicle's velocity, m/s ENU; one that is not finite is as if it had not come."""
        if math.isfinite(velocity[0] + velocity[1] + velocity[2]):
            self.velocity_rows[index] = velocity
            self.velocity_heard[index] = self.ticks
            self._velocities = None

    def restart(self) -> None:
        """Know nothing again, as after construction."""
        self.position_rows[:] = self.velocity_rows[:] = 0.0
        self.heard[:] = self.velocity_heard[:] = NEVER
        self.ticks = 0
        self._positions = self._velocities = None

    def tick(self) -> None:
        """Count one period of the control loop; call it once per period, after everything has been updated."""
        self.ticks += 1

    def fresh(self, index: int, ticks: int) -> bool:
        """Return whether a position of this vehicle came in the last ``ticks`` ticks."""
        heard = int(self.heard[index])
        return heard != NEVER and self.ticks - heard <= ticks


def _take(values: ArrayLike, into: NDArray[np.float64], heard: NDArray[np.int64], tick: int) -> None:
    """Copy the finite ones of N rows, and note the tick for them."""
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


def as_vector(value: Sequence[float]) -> Vector | None:
    """Return ``value`` (a tuple, list or array) as three finite floats, None if it is not that."""
    try:
        x, y, z = (float(v) for v in value)
    except (TypeError, ValueError):
        return None
    return (x, y, z) if math.isfinite(x) and math.isfinite(y) and math.isfinite(z) else None
