"""Pacing: how long to wait so that simulated time keeps its ratio to wall time, and what the ratio really is."""

from __future__ import annotations

import math
from collections import deque

from xtdrone_control.speed import LEAST_SPEED

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
        """Change the target factor: 0 (unlimited) or LEAST_SPEED and more.

        Raises:
            ValueError: another value.
        """
        if not math.isfinite(speed) or (speed != 0.0 and speed < LEAST_SPEED):
            raise ValueError(f"speed: {speed} is not allowed, 0 (unlimited) or at least {LEAST_SPEED}")
        self.speed = speed
        self.restart()

    def restart(self) -> None:
        """Count from the next call of ``delay``: simulated time has stood still, or was set back."""
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


class SpeedMeter:
    """The real-time factor over the last second or so of wall time."""

    def __init__(self, span: float = 1.0, spacing: float = 0.1) -> None:
        """Know nothing yet.

        Args:
            span: wall seconds over which the factor is taken.
            spacing: wall seconds between two samples that are kept.
        """
        self._span = span
        self._spacing = spacing
        self._samples: deque[tuple[float, int]] = deque()

    def restart(self) -> None:
        """Forget the samples: simulated time was set back."""
        self._samples.clear()

    def factor(self, sim_us: int, wall: float) -> float:
        """Take a sample and return the factor; 0 before there are two.

        Args:
            sim_us: simulated time, microseconds; never less than at the last call, see :meth:`restart`.
            wall: monotonic wall time, s.
        """
        samples = self._samples
        while len(samples) > 1 and wall - samples[1][0] >= self._span:
            samples.popleft()
        factor = 0.0
        if samples and wall > samples[0][0]:
            factor = (sim_us - samples[0][1]) * 1e-6 / (wall - samples[0][0])
        if not samples or wall - samples[-1][0] >= self._spacing:
            samples.append((wall, sim_us))
        return factor
