"""Pacing of simulated time against wall time, and measurement of the real-time factor."""

from __future__ import annotations

import math
from collections import deque

from xtdrone_common.programs.node_command_line import LEAST_SPEED

_MAX_LAG = 0.2  # wall s; a simulation further behind does not catch up


class Pacer:
    """Target real-time factor; 0 means unlimited.

    Attributes:
        speed: the target factor.
    """

    def __init__(self, speed: float) -> None:
        """Set the initial target factor, see :meth:`set_speed`."""
        self.speed = 0.0
        self._sim_us = 0
        self._wall: float | None = None
        self.set_speed(speed)

    def set_speed(self, speed: float) -> None:
        """Set the target factor: 0 (unlimited) or at least LEAST_SPEED.

        Raises:
            ValueError: the value is not allowed.
        """
        if not math.isfinite(speed) or (speed != 0.0 and speed < LEAST_SPEED):
            raise ValueError(f"speed: {speed} is not allowed, 0 (unlimited) or at least {LEAST_SPEED}")
        self.speed = speed
        self.restart()

    def restart(self) -> None:
        """Restart the reference at the next call of ``delay``, after a standstill or a reset of simulated time."""
        self._wall = None

    def delay(self, sim_us: int, wall: float) -> float:
        """Return the time to wait, wall s.

        Args:
            sim_us: simulated time, microseconds.
            wall: monotonic wall time, s.
        """
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
    """Measures the real-time factor over the most recent ``span`` of wall time."""

    def __init__(self, span: float = 1.0, spacing: float = 0.1) -> None:
        """Start without samples.

        Args:
            span: length of the averaging window, wall s.
            spacing: minimum time between stored samples, wall s.
        """
        self._span = span
        self._spacing = spacing
        self._samples: deque[tuple[float, int]] = deque()

    def restart(self) -> None:
        """Discard the samples after a reset of simulated time."""
        self._samples.clear()

    def factor(self, sim_us: int, wall: float) -> float:
        """Add a sample and return the factor; 0 until two samples exist.

        Args:
            sim_us: simulated time, microseconds; not less than in the previous call, see :meth:`restart`.
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
