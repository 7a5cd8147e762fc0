"""The frame of the nodes that measure for a whole fleet: their parameters, and the times of their measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import rosgraph
import yaml

from xtdrone_control import lockstep
from xtdrone_control.settings import setting


def private_parameters(name: str, arguments: Sequence[str]) -> dict[str, Any]:
    """Return the private parameters before the node is registered: the rate of its turns depends on them.

    Args:
        name: of the node, unless the command line gives another.
        arguments: the command line, with ``_rate:=2`` and the like.
    """
    name = lockstep.future_name(name)
    found = rosgraph.Master(name).getParam("/")
    for part in name.strip("/").split("/"):
        found = found.get(part, {}) if isinstance(found, Mapping) else {}
    values = dict(found) if isinstance(found, Mapping) else {}
    for argument in arguments:
        key, mapped, text = argument.partition(":=")
        if mapped and key.startswith("_") and not key.startswith("__"):
            values[key[1:]] = yaml.safe_load(text)
    return values


def rate_setting(low: float, high: float, text: str) -> Any:
    """Declare the rate of all sensors of a node: 0 for each one's own, or ``low`` to ``high``, Hz."""

    def check(rate: float) -> None:
        if 0.0 < rate < low:
            raise ValueError

    allowed = f"0, or {low:g} to {high:g} Hz"
    return setting(0.0, low=0.0, high=high, unit="Hz", check=check, allowed=allowed, text=text)


def time_us(rate: float, number: int) -> int:
    """Return the time of measurement ``number`` at ``rate`` Hz, microseconds."""
    return round(number * 1e6 / rate)


class Due:
    """Returns each measurement of a sensor once, as soon as simulated time has covered it."""

    def __init__(self, rate: float, periods: int = 0) -> None:
        """Start at the first time that is passed to ``numbers``.

        Args:
            rate: of the sensor, Hz.
            periods: duration of a measurement in periods: 0 for an instant, 1 for one that lasts until the next begins.
        """
        self._rate, self._periods = rate, periods
        self._next: int | None = None

    def restart(self) -> None:
        """Restart, after a reset of simulated time."""
        self._next = None

    def numbers(self, first_us: int, last_us: int) -> range:
        """Return the measurements that have ended by ``last_us`` and have not been returned before.

        Args:
            first_us: no measurement begins before it in the first call, microseconds.
            last_us: latest end, microseconds.
        """
        if self._next is None:
            self._next = max(0, int(first_us * 1e-6 * self._rate) - 1)
            while time_us(self._rate, self._next) < first_us:
                self._next += 1
        first = self._next
        while time_us(self._rate, self._next + self._periods) <= last_us:
            self._next += 1
        return range(first, self._next)
