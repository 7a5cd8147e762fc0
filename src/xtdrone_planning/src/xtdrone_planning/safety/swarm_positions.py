"""Positions of all vehicles as received by the safety filter, with the age of each. No ROS."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FIELDS = 6  # numbers a vehicle in the message of all: x, y, z, vx, vy, vz; m, m/s, ENU


class SwarmPositions:
    """Positions and velocities of N vehicles, and the times of their reception.

    Attributes:
        positions: shape (N, 3), m ENU; NaN: never received.
        velocities: shape (N, 3), m/s ENU; 0: never received.
        heard: times of reception, shape (N,), s.
    """

    def __init__(self, count: int) -> None:
        """Start without data about ``count`` vehicles."""
        self.positions = np.full((count, 3), np.nan)
        self.velocities = np.zeros((count, 3))
        self.heard = np.full(count, -np.inf)

    def restart(self) -> None:
        """Forget everything."""
        self.positions[:], self.velocities[:], self.heard[:] = np.nan, 0.0, -np.inf

    def on_position(self, index: int, position: Sequence[float], now: float) -> None:
        """Store a position (m ENU) received now (s), unless it is not finite."""
        if np.all(np.isfinite(position)):
            self.positions[index], self.heard[index] = position, now

    def on_velocity(self, index: int, velocity: Sequence[float]) -> None:
        """Store a velocity (m/s ENU), unless it is not finite."""
        if np.all(np.isfinite(velocity)):
            self.velocities[index] = velocity

    def on_all(self, numbers: Sequence[float], now: float) -> None:
        """Store the states of all vehicles, FIELDS numbers each; those that are not finite are ignored.

        Raises:
            ValueError: the number of values is wrong.
        """
        rows = np.array(numbers, dtype=np.float64)
        if len(rows) != FIELDS * len(self.heard):
            raise ValueError(f"{len(rows)} numbers are not allowed, {FIELDS} for each of {len(self.heard)} vehicles")
        rows = rows.reshape(-1, FIELDS)
        valid = np.isfinite(rows).all(axis=1)
        self.positions[valid], self.velocities[valid], self.heard[valid] = rows[valid, :3], rows[valid, 3:], now

    def at(self, now: float, longest: float) -> NDArray[np.float64]:
        """Return the current positions, shape (N, 3), m: each extrapolated with its velocity, for at most ``longest``
        s."""
        age = np.clip(np.where(np.isfinite(self.heard), now - self.heard, 0.0), 0.0, longest)
        moved: NDArray[np.float64] = self.positions + self.velocities * age[:, None]
        return moved

    def old(self, now: float, timeout: float) -> list[int]:
        """Return the vehicles whose position is older than ``timeout`` s."""
        return [int(i) for i in np.flatnonzero(now - self.heard > timeout)]
