"""Health monitoring of odometry: faults of a scan, and the resulting state."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.pose_matrices import angle_between, distance_between
from xtdrone_common.settings import Settings, setting

Array = NDArray[np.float64]


class Fault(Enum):
    """A fault of odometry; ``words`` describes it."""

    SILENT = "no {noun}s arrive"
    FROZEN = "{noun}s do not change"
    BLIND = "too few points are seen"
    UNMATCHED = "too few points fit the map"
    DEGENERATE = "the surroundings do not constrain the position"
    RESIDUAL = "the {noun} does not fit the map"
    DIVERGED = "the position contradicts the autopilot's motion"
    LATE = "{noun}s are dropped: registration takes too long"

    def words(self, noun: str) -> str:
        """Return the fault in words; noun: name of a measurement, e.g. ``scan``."""
        return self.value.format(noun=noun)


class OdometryState(Enum):
    """OdometryState of the odometry."""

    WAITING = "waiting for the first {noun}"
    GOOD = "good"
    LOST = "lost"

    def words(self, noun: str) -> str:
        """Return the state in words; noun: name of a measurement, e.g. ``scan``."""
        return self.value.format(noun=noun)


@dataclass(frozen=True)
class HealthLimits(Settings):
    """Private parameters of the supervision."""

    silence: float = setting(0.35, low=0.05, high=10.0, unit="s", text="time without a scan that counts as a fault")
    frozen: int = setting(2, low=1, high=100, text="consecutive identical scans that count as a fault")
    least_share: float = setting(0.5, low=0.0, high=1.0, text="minimum fraction of map correspondences")
    least_information: float = setting(
        0.01, low=0.0, high=1.0, text="minimum information in the weakest direction, relative to the strongest"
    )
    most_residual: float = setting(3.0, above=0.0, high=100.0, text="maximum RMS of normalised residuals")
    most_jump: float = setting(
        0.5, above=0.0, high=100.0, unit="m", text="maximum distance of a scan's position from the predicted one"
    )
    most_turn: float = setting(
        0.15, above=0.0, high=3.2, unit="rad", text="maximum angle of a scan's attitude from the predicted one"
    )
    patience: int = setting(2, low=1, high=100, text="consecutive bad scans after which odometry counts as lost")
    recovery: int = setting(
        10, low=1, high=1000, text="consecutive good scans after which odometry counts as good again"
    )


def weakest_share(information: Array) -> float:
    """Return the ratio of the smallest to the largest eigenvalue of an information matrix, 0..1."""
    values = np.linalg.eigvalsh(information)
    return float(max(values[0], 0.0) / values[-1]) if values[-1] > 0.0 else 0.0


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Result of the registration of one measurement.

    Attributes:
        pose: (4, 4) body to map, at the time of the measurement.
        predicted: (4, 4) before the registration.
        count: points that were registered.
        share: fraction of these that have a correspondence, 0..1.
        residual: RMS of the normalised residuals.
        weakest: information in the weakest direction relative to the strongest, 0..1; small where the surroundings do
            not constrain the position: a plain, a long corridor.
        covariance: (6, 6) of x, y, z (m, map's axes) and rotation (rad, body's axes).
        is_first: whether the map was empty.
    """

    pose: Array
    predicted: Array
    count: int
    share: float
    residual: float
    weakest: float
    covariance: Array
    is_first: bool = False

    @property
    def jump(self) -> float:
        """Distance between prediction and result, m."""
        return distance_between(self.predicted, self.pose)

    @property
    def turn(self) -> float:
        """Angle between prediction and result, rad."""
        return angle_between(self.predicted, self.pose)


def without_registration(predicted: Array, count: int, is_first: bool) -> dict[str, Any]:
    """Return the fields of an estimate that is not registered: the first one, or one with too few points."""
    covariance = np.diag([1e-6] * 6) if is_first else np.eye(6)
    figures = {"share": float(is_first), "residual": 0.0, "weakest": float(is_first), "covariance": covariance}
    return {"pose": predicted, "predicted": predicted, "count": count, "is_first": is_first, **figures}


def fault_of(found: Estimate, same: int, least_points: int, limits: HealthLimits) -> Fault | None:
    """Return the first fault of a measurement, None for a good one.

    Args:
        found: Result of its registration.
        same: Number of identical measurements before it, 0 for a new one.
        least_points: Minimum for a registration.
        limits: Limits of the supervision.
    """
    if same >= limits.frozen:
        return Fault.FROZEN
    if found.count < least_points:
        return Fault.BLIND
    if found.is_first:
        return None
    checks = (
        (found.share < limits.least_share, Fault.UNMATCHED),
        (found.weakest < limits.least_information, Fault.DEGENERATE),
        (found.residual > limits.most_residual, Fault.RESIDUAL),
        (found.jump > limits.most_jump or found.turn > limits.most_turn, Fault.DIVERGED),
    )
    return next((fault for is_bad, fault in checks if is_bad), None)


@dataclass
class Health:
    """OdometryState of the odometry over time.

    Bad scans are never published. After ``patience`` of them, or silence, odometry counts as lost, and as good again
    after ``recovery`` good scans.

    Attributes:
        limits: Limits of the supervision.
        state: State of the odometry.
        fault: Fault of the last scan, or the reason why odometry is lost.
    """

    limits: HealthLimits
    state: OdometryState = OdometryState.WAITING
    fault: Fault | None = None
    _bad: int = field(default=0, repr=False)
    _good: int = field(default=0, repr=False)
    _last: float | None = field(default=None, repr=False)  # s, time of the last scan

    def on_scan(self, now: float, fault: Fault | None) -> bool:
        """Record a scan and return whether its pose may be published.

        Args:
            now: time, s.
            fault: Fault of the scan.
        """
        self._last = now
        if fault is not None:
            self._good, self._bad, self.fault = 0, self._bad + 1, fault
            if self._bad >= self.limits.patience or self.state is OdometryState.WAITING:
                self.state = OdometryState.LOST
            return False
        self._bad, self._good = 0, self._good + 1
        if self.state is OdometryState.LOST and self._good < self.limits.recovery:
            return False
        self.state, self.fault = OdometryState.GOOD, None
        return True

    def on_time(self, now: float) -> None:
        """Check whether scans have stopped.

        Args:
            now: time, s.
        """
        if self._last is not None and now - self._last > self.limits.silence and self.fault is not Fault.SILENT:
            self.state, self.fault, self._good = OdometryState.LOST, Fault.SILENT, 0
