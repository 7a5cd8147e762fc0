"""Monitoring of the sensor that feeds the map: silent, frozen, without a pose, or seeing nothing."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_common.settings import Settings, setting


@dataclass(frozen=True)
class WatchSettings(Settings):
    """Conditions under which a sensor counts as failed."""

    silence: float = setting(0.5, low=0.05, high=10.0, unit="s", text="a sensor silent for longer counts as failed")
    repeats: int = setting(
        4, low=2, high=100, text="number of bit-identical measurements in a row after which a sensor counts as failed"
    )


class SensorWatch:
    """Monitors the measurements of one sensor.

    Attributes:
        count: measurements that were mapped.
    """

    def __init__(self, settings: WatchSettings) -> None:
        """Start without a measurement."""
        self._settings = settings
        self.restart()

    def restart(self) -> None:
        """Forget all measurements."""
        self.count = 0
        self._last: float | None = None
        self._payload = b""
        self._repeats = 0
        self._returns = 0
        self._reason = ""

    def take(self, payload: bytes, returns: int) -> bool:
        """Check a measurement; return whether it may be mapped.

        Args:
            payload: its values as received.
            returns: number of rays with a return.
        """
        same = returns > 0 and payload == self._payload
        self._repeats = self._repeats + 1 if same else 0
        self._payload, self._returns = payload, returns
        return not self.is_frozen

    def mapped(self, time: float) -> None:
        """Record that a measurement was mapped at ``time``, s of ROS time."""
        self.count += 1
        self._last, self._reason = time, ""

    def rejected(self, reason: str) -> None:
        """Record why a measurement was not mapped."""
        self._reason = reason

    @property
    def is_frozen(self) -> bool:
        """Whether the sensor is frozen."""
        return self._repeats + 1 >= self._settings.repeats

    @property
    def sees_nothing(self) -> bool:
        """Whether the last measurement had no return within range."""
        return self.count > 0 and self._returns == 0

    def fault(self, now: float) -> str:
        """Return the sensor's fault at ``now``, s; empty if there is none."""
        if self.is_frozen:
            return f"sensor frozen: {self._repeats + 1} equal measurements"
        if self._last is None:
            return self._reason or "sensor silent: no measurement yet"
        if now - self._last > self._settings.silence:
            return self._reason or f"sensor silent for {now - self._last:.1f} s"
        return ""
