"""Pacing: how long to wait so that simulated time keeps its ratio to wall time."""

from __future__ import annotations

import math

_MAX_LAG = 0.2  # s of wall time; a simulation further behind does not hurry to catch up


class Pacer:
    """Target real-time factor; 0 means unlimited.

    Attributes:
        speed: the target factor.
    """

    def __init__(self, speed: float) -> None:
        """Start with ``speed``; see :meth:`set_speed`."""
        self.speed = 0.0
        self._sim_us = 0
        self._wall: float | None = None
        self.set_speed(speed)

    def set_speed(self, speed: float) -> None:
        """Change the target factor: 0 (unlimited) or 0.1 and more.

        Raises:
            ValueError: another value.
        """
        if not math.isfinite(speed) or (speed != 0.0 and speed < 0.1):
            raise ValueError(f"speed: {speed} is not allowed, 0 (unlimited) or at least 0.1")
        self.speed = speed
        self._wall = None

    def delay(self, sim_us: int, wall: float) -> float:
        """Return for how many seconds of wall time to wait at simulated time ``sim_us`` and wall time ``wall``."""
        if self.speed == 0.0:
            return 0.0
        if self._wall is None:
            self._sim_us, self._wall = sim_us, wall
            return 0.0
        due = self._wall + (sim_us - self._sim_us) * 1e-6 / self.speed
        if wall - due > _MAX_LAG:
            self._sim_us, self._wall = sim_us, wall
            return 0.0
        return max(due - wall, 0.0)
