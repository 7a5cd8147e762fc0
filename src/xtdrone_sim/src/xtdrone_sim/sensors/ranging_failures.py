"""Failures of lidars and UWB sensors, which users inject by the service ``TOPIC/failure``."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_control.settings import check_choice, check_range

FAILURES = ("ok", "off", "frozen", "biased", "dropouts")
MOST_BIAS = 100.0  # m


@dataclass(frozen=True)
class RangingFailure:
    """Failure of a lidar or a UWB sensor.

    Attributes:
        kind: of ``FAILURES``.
        value: m of a bias, 0..1 of dropouts.
    """

    kind: str = "ok"
    value: float = 0.0

    def __str__(self) -> str:
        """Return the kind, and the value if the kind has one."""
        return f"{self.kind} {self.value:g}" if self.kind in ("biased", "dropouts") else self.kind

    @property
    def bias(self) -> float:
        """Error of all ranges, m."""
        return self.value if self.kind == "biased" else 0.0

    @property
    def dropouts(self) -> float:
        """Share of the ranges that the failure loses, 0..1."""
        return self.value if self.kind == "dropouts" else 0.0

    @classmethod
    def checked(cls, kind: str, value: float) -> RangingFailure:
        """Return a failure.

        Raises:
            ValueError: kind or value is not allowed.
        """
        check_choice("failure", kind, FAILURES)
        if kind == "biased":
            check_range("value", value, -MOST_BIAS, MOST_BIAS, "m")
        if kind == "dropouts":
            check_range("value", value, 0.0, 1.0)
        return cls(kind, value)
