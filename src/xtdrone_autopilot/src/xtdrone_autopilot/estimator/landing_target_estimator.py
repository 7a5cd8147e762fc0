"""Motion of a landing target, as in PX4's landing_target_estimator: position and velocity from observed positions.

A Kalman filter per horizontal axis with a white acceleration (LTEST_ACC_UNC) and an error of the observation that grows
with the height above the target (LTEST_MEAS_UNC). PX4's state is relative to the vehicle, with the vehicle's
acceleration as input; here it is the target's in local NED, which gives the same filter as long as the vehicle's
position is known; observations are fused at the time at which they were made.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from xtdrone_autopilot.vehicle_view import Vector

MOVING = 0  # LTEST_MODE
_GATE = 3.84  # squared normalised innovation above which an observation is rejected: one in twenty good ones
_TIMEOUT_US = 2_000_000  # without an accepted observation, after which the next one starts again
_LEAST_HEIGHT = 0.1  # m, height of the camera above the target below which the error stays the same


@dataclass(frozen=True)
class TargetMotion:
    """Estimated motion of a target.

    Attributes:
        position: m, local NED.
        velocity: north and east, m/s.
        time_us: simulated time of the last accepted observation, microseconds.
    """

    position: Vector
    velocity: tuple[float, float]
    time_us: int


@dataclass
class _Axis:
    """Position, m, velocity, m/s, and their covariance."""

    position: float
    velocity: float
    p00: float
    p01: float
    p11: float

    def predict(self, dt: float, acceleration: float) -> None:
        """Advance by ``dt`` s; ``acceleration`` is a variance, m^2/s^4."""
        self.position += self.velocity * dt
        self.p00 += dt * (2.0 * self.p01 + dt * self.p11) + 0.25 * dt**4 * acceleration
        self.p01 += dt * self.p11 + 0.5 * dt**3 * acceleration
        self.p11 += dt * dt * acceleration

    def accepts(self, observed: float, variance: float) -> bool:
        """Return whether an observation, m, of a variance, m^2, can belong to the target."""
        return (observed - self.position) ** 2 <= _GATE * (self.p00 + variance)

    def correct(self, observed: float, variance: float) -> None:
        """Fuse an observation."""
        total = self.p00 + variance
        k0, k1 = self.p00 / total, self.p01 / total
        residual = observed - self.position
        self.position += k0 * residual
        self.velocity += k1 * residual
        self.p11 -= k1 * self.p01
        self.p01 -= k0 * self.p01
        self.p00 -= k0 * self.p00


class LandingTargetEstimator:
    """Motion of one vehicle's landing target."""

    def __init__(self, get: Callable[[str], float]) -> None:
        """Start without a target; ``get`` returns a parameter by name."""
        self._get = get
        self._axes: tuple[_Axis, _Axis] | None = None
        self._down = 0.0
        self._state_us = self._accepted_us = 0

    def see(self, position: Vector, height: float, time_us: int) -> bool:
        """Fuse an observation; one that is older than the last counts as simultaneous with it.

        Args:
            position: m, local NED.
            height: of the vehicle above the target, m.
            time_us: simulated time of the observation, microseconds.

        Returns:
            Whether it was accepted.
        """
        variance = max(self._get("LTEST_MEAS_UNC"), 1e-9) * max(abs(height), _LEAST_HEIGHT) ** 2
        axes = self._axes
        if axes is None or not 0 <= time_us - self._accepted_us + _TIMEOUT_US <= 2 * _TIMEOUT_US:
            self._start(position, time_us)
            return True
        dt = max(time_us - self._state_us, 0) * 1e-6
        for axis in axes:
            axis.predict(dt, max(self._get("LTEST_ACC_UNC"), 0.0))
        self._state_us = max(time_us, self._state_us)
        if not all(axis.accepts(seen, variance) for axis, seen in zip(axes, position, strict=False)):
            return False
        for axis, seen in zip(axes, position, strict=False):
            axis.correct(seen, variance)
        self._down, self._accepted_us = position[2], self._state_us
        return True

    def at(self, time_us: int) -> TargetMotion | None:
        """Return the motion expected at a time, microseconds; None before the first observation."""
        if self._axes is None:
            return None
        dt = (time_us - self._state_us) * 1e-6
        north, east = self._axes
        place = (north.position + north.velocity * dt, east.position + east.velocity * dt, self._down)
        if not all(map(math.isfinite, place)):
            return None
        return TargetMotion(place, (north.velocity, east.velocity), self._accepted_us)

    def _start(self, position: Vector, time_us: int) -> None:
        place, speed = max(self._get("LTEST_POS_UNC_IN"), 0.0), max(self._get("LTEST_VEL_UNC_IN"), 0.0)
        self._axes = (_Axis(position[0], 0.0, place, 0.0, speed), _Axis(position[1], 0.0, place, 0.0, speed))
        self._down = position[2]
        self._state_us = self._accepted_us = time_us
