"""Position of one neighbour relative to this vehicle: an extended Kalman filter on ranges and bearings.

The state is r = x_neighbour - x_own in the axes of map (all vehicles share a compass). It is propagated by the
difference of the vehicles' own velocity estimates; their errors, correlated over about 1 s, are the process noise (A.
Martinelli et al., Multi-robot localization using relative observations, ICRA 2005, for the same state). From ranges
alone, r is observable only if the relative motion changes direction; the covariance shows it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.settings import Settings, setting
from xtdrone_perception.localisation.first_fix import Ranges, first_fix

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FilterSettings(Settings):
    """Settings of the filter of each neighbour."""

    drift: float = setting(
        0.05, low=0.0, high=10.0, unit="m/sqrt(s)",
        text="growth of the relative odometry error: standard deviation after one second",
    )  # fmt: skip
    gate: float = setting(4.0, low=1.0, high=100.0, text="standard deviations beyond which a measurement is an outlier")
    height_deviation: float = setting(
        0.5, low=0.0, high=100.0, unit="m",
        text="standard deviation of the difference of broadcast heights; 0: heights are not used",
    )  # fmt: skip
    window: float = setting(20.0, low=1.0, high=300.0, unit="s", text="time span of the ranges used for the first fix")
    worst_start: float = setting(
        1.0, above=0.0, high=100.0, unit="m", text="maximum standard deviation, in any direction, of the first fix"
    )
    worst: float = setting(
        2.0, above=0.0, high=1000.0, unit="m",
        text="maximum standard deviation, in any direction, of a position that is used",
    )  # fmt: skip
    lost: int = setting(30, low=1, high=10000, text="consecutive outliers after which the filter restarts")


class _Heard(NamedTuple):
    """A range before the first fix: time, s, range, deviation and lever arm, m, and the displacement so far, m."""

    time: float
    measured: float
    deviation: float
    lever: Array
    moved: Array


class RelativeFilter:
    """Position filter of one neighbour.

    Attributes:
        position: relative to this vehicle, (3,) m, axes of map; NaN before the first fix.
        covariance: (3, 3), m^2.
        outliers: measurements rejected so far.
    """

    _TRIES = 1.0  # s between two attempts at a first fix

    def __init__(self, settings: FilterSettings) -> None:
        """Start without a position."""
        self._settings = settings
        self.outliers = 0
        self.restart()

    def restart(self) -> None:
        """Forget the position."""
        self.position: Array = np.full(3, np.nan)
        self.covariance: Array = np.full((3, 3), np.inf)
        self._ready = False
        self._window: deque[_Heard] = deque()
        self._moved: Array = np.zeros(3)
        self._time = self._tried = 0.0
        self._rejected = 0
        self._height = math.nan

    @property
    def known(self) -> bool:
        """Whether the position is accurate enough to be used."""
        return self._ready and self.deviation <= self._settings.worst

    @property
    def deviation(self) -> float:
        """Standard deviation in the worst direction, m; infinite before the first fix."""
        return math.sqrt(max(float(np.linalg.eigvalsh(self.covariance)[-1]), 0.0)) if self._ready else math.inf

    def predict(self, dt: float, velocity: Array) -> None:
        """Predict ``dt`` s ahead with the neighbour's velocity relative to this vehicle's, (3,) m/s."""
        step = np.asarray(velocity, float) * dt
        self._time += dt
        self._moved = self._moved + step
        if self._ready:
            self.position = self.position + step
            self.covariance = self.covariance + self._settings.drift**2 * dt * np.eye(3)

    def add_height(self, height: float) -> None:
        """Fuse the neighbour's height above this vehicle, m, from the heights that both report."""
        if self._settings.height_deviation == 0.0 or not math.isfinite(height):
            return
        self._height = height
        if self._ready:  # the error is persistent: it bounds the covariance and does not average out
            variance = self._settings.height_deviation**2
            if self.covariance[2, 2] > variance:
                excess = variance * self.covariance[2, 2] / (self.covariance[2, 2] - variance)
                self._correct(np.array([[0.0, 0.0, 1.0]]), np.array([height - self.position[2]]), np.array([excess]))

    def add_range(self, measured: float, deviation: float, lever: Array) -> None:
        """Fuse a range, m.

        Args:
            measured: m.
            deviation: standard deviation, m.
            lever: Lever of the antennas from the origins: the neighbour's minus this vehicle's, (3,) m.
        """
        if not (math.isfinite(measured) and measured > 0.0 and math.isfinite(deviation)):
            return
        deviation = max(deviation, 1e-3)
        if not self._ready:
            self._collect(measured, deviation, lever)
            return
        line = self.position + lever
        length = max(float(np.linalg.norm(line)), 1e-6)
        spread = float(np.trace(self.covariance)) - float(line @ self.covariance @ line) / length**2
        curved = 0.5 * spread / length  # of the range over the covariance, to second order
        variance = deviation**2 + 0.5 * curved**2
        self._correct(line[None] / length, np.array([measured - length - curved]), np.array([variance]))

    def add_bearing(
        self, azimuth: float, elevation: float, deviation: float, attitude: Array, lever: Array, measured: float
    ) -> None:
        """Fuse a bearing; with the range ``measured``, m, it gives the first fix.

        Args:
            azimuth, elevation: in the sensor's frame, rad.
            deviation: standard deviation of both, rad.
            attitude: Attitude of the sensor's frame in map, (3, 3).
            lever: as in ``add_range``, (3,) m.
            measured: range of the same time, m.
        """
        deviation = max(deviation, 1e-4)
        ca, sa, ce, se = math.cos(azimuth), math.sin(azimuth), math.cos(elevation), math.sin(elevation)
        ahead = attitude @ np.array([ce * ca, ce * sa, se])
        across = attitude @ np.array([[-sa, ca, 0.0], [-se * ca, -se * sa, ce]]).T  # (3, 2)
        if not self._ready:
            wide, far = (deviation * measured) ** 2, (0.1 * measured + 0.3) ** 2  # the range may be an outlier
            self._start(measured * ahead - lever, wide * across @ across.T + far * np.outer(ahead, ahead))
            return
        line = self.position + lever
        length = max(float(np.linalg.norm(line)), 0.1)
        flat = max(ce, 0.05) * deviation  # an azimuth error shifts the direction in proportion to cos(elevation)
        slope = across.T @ (np.eye(3) - np.outer(line, line) / length**2) / length
        self._correct(slope, -across.T @ line / length, np.array([flat**2, deviation**2]))

    # parts

    def _correct(self, slope: Array, residual: Array, variances: Array) -> None:
        """Fuse a measurement unless it is an outlier (Joseph form)."""
        total = slope @ self.covariance @ slope.T + np.diag(variances)
        squared = float(residual @ np.linalg.solve(total, residual))
        if squared > self._settings.gate**2 + 2.0 * (len(residual) - 1):
            self.outliers += 1
            self._rejected += 1
            if self._rejected >= self._settings.lost:
                self.restart()
            return
        self._rejected = 0
        gain = np.linalg.solve(total, slope @ self.covariance).T
        keep = np.eye(3) - gain @ slope
        self.position = self.position + gain @ residual
        self.covariance = keep @ self.covariance @ keep.T + gain @ np.diag(variances) @ gain.T

    def _collect(self, measured: float, deviation: float, lever: Array) -> None:
        self._window.append(_Heard(self._time, measured, deviation, lever, self._moved))
        while self._window[0].time < self._time - self._settings.window:
            self._window.popleft()
        if self._time - self._tried < self._TRIES:
            return
        self._tried = self._time
        heard = list(self._window)
        age = np.array([self._time - entry.time for entry in heard])
        wander = self._settings.drift**2 * age
        spread = np.array([entry.deviation for entry in heard]) ** 2 + wander
        shift = np.array([entry.lever - (self._moved - entry.moved) for entry in heard])
        ranges = Ranges(np.array([entry.measured for entry in heard]), np.sqrt(spread), shift, wander)
        known = self._settings.height_deviation > 0.0 and math.isfinite(self._height)
        height = (self._height, self._settings.height_deviation) if known else (0.0, math.inf)
        fix = first_fix(ranges, *height, self._settings.worst_start)
        if fix is not None:
            self._start(fix.position, fix.covariance)

    def _start(self, position: Array, covariance: Array) -> None:
        self.position, self.covariance = np.asarray(position, float), np.asarray(covariance, float)
        self._ready = True
        self._rejected = 0
        self._window.clear()
