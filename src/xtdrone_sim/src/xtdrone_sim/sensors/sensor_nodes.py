"""The frame of the nodes that measure for a whole fleet: parameters, times of measurements, and the run."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import rosgraph
import rospy
import yaml

import xtdrone_lockstep as lockstep
from xtdrone_common.fleet import Vehicle
from xtdrone_common.programs.node_command_line import ArgumentError, check_no_arguments, fleet_of
from xtdrone_common.settings import Settings, setting

_Declared = TypeVar("_Declared", bound=Settings)


def read_start(
    name: str, kind: type[_Declared], fleet: str, arguments: Sequence[str]
) -> tuple[str, tuple[Vehicle, ...], _Declared]:
    """Return the text of the fleet, its vehicles, and the settings of a node that is not registered yet.

    Args:
        name: name of the node.
        kind: class of its private parameters.
        fleet: fleet without ``/xtdrone/fleet``.
        arguments: its arguments, none of which is allowed.

    Raises:
        ArgumentError: an argument or parameter is not allowed.
    """
    check_no_arguments(arguments)
    given = private_parameters(name, sys.argv)
    text = str(given.get("fleet") or rospy.get_param("/xtdrone/fleet", fleet))
    try:
        settings = kind.from_parameters(lambda key, default: given.get(key[1:], default))
        return text, fleet_of(text) or (), settings
    except ValueError as error:
        raise ArgumentError(str(error)) from error


def run(begin: Callable[[str], None], step: Callable[[], None], close: Callable[[], None]) -> None:
    """Run a node in the lockstep until shutdown.

    Args:
        begin: called with the name or file of the world when the simulator is running.
        step: called in each turn.
        close: called at the end.
    """
    try:
        lockstep.start()  # returns when the simulator is running and has set the world
        begin(str(rospy.get_param("~world", rospy.get_param("/xtdrone/world", "empty"))))
        lockstep.spin(step)
    finally:
        close()


def private_parameters(name: str, arguments: Sequence[str]) -> dict[str, Any]:
    """Return the private parameters before the node is registered: the rate of its turns depends on them.

    Args:
        name: name of the node, unless the command line gives another.
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
            rate: rate of the sensor, Hz.
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
