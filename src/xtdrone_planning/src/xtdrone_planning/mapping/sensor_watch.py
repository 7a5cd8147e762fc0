"""Whether the sensor that maps can be relied on: silent, frozen, without a pose, or seeing nothing."""

from __future__ import annotations

from dataclasses import dataclass

from xtdrone_control.settings import Settings, setting


@dataclass(frozen=True)
class WatchSettings(Settings):
    """When a sensor counts as failed."""

    silence: float = setting(
        0.5, low=0.05, high=10.0, unit="s", text="a sensor without a measurement for longer has failed"
    )
    repeats: int = setting(
        4, low=2, high=100, text="a sensor that repeats a measurement bit by bit so often has failed"
    )


class SensorWatch:
    """Judges the stream of measurements of one sensor.

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
        """Regard a measurement; return whether it may be mapped.

        Args:
            payload: its values as received.
            returns: number of rays that have met something.
        """
        same = returns > 0 and payload == self._payload
        self._repeats = self._repeats + 1 if same else 0
        self._payload, self._returns = payload, returns
        return not self.is_frozen

    def mapped(self, time: float) -> None:
        """Note that a measurement was mapped at ``time``, s of ROS time."""
        self.count += 1
        self._last, self._reason = time, ""

    def rejected(self, reason: str) -> None:
        """Note why a measurement was not mapped."""
        self._reason = reason

    @property
    def is_frozen(self) -> bool:
        """Whether the sensor repeats itself."""
        return self._repeats + 1 >= self._settings.repeats

    @property
    def sees_nothing(self) -> bool:
        """Whether nothing was within range in the last measurement."""
        return self.count > 0 and self._returns == 0

    def fault(self, now: float) -> str:
        """Return why the sensor cannot be relied on at ``now``, s; empty if it can."""
        if self.is_frozen:
            return f"sensor frozen: {self._repeats + 1} equal measurements"
        if self._last is None:
            return self._reason or "sensor silent: no measurement yet"
        if now - self._last > self._settings.silence:
            return self._reason or f"sensor silent for {now - self._last:.1f} s"
        return ""
