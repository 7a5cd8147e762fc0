"""The parameters of the ROS parameter server for Foxglove's clients."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from foxglove import Parameter

from xtdrone_interaction.parameter_secrets import is_secret, without_secrets
from xtdrone_interaction.topics.ros_names import RosNameError, absolute_name

_MAX = 5000  # parameters sent at a time
_MAX_INTEGER = 1 << 31  # of the parameter server's XML-RPC


class ParameterError(ValueError):
    """A parameter that cannot be set."""


def flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Return the values of a tree of parameters by their full names."""
    if not isinstance(tree, Mapping):
        return {prefix or "/": tree}
    found: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping) and value:
            found |= flat(value, f"{prefix}/{name}")
        else:
            found[f"{prefix}/{name}"] = value
    return found


def to_parameter(name: str, value: Any) -> Parameter | None:
    """Return a parameter for clients; None if the protocol cannot represent the value."""
    try:
        return Parameter(name, value=_plain(value))
    except (TypeError, ValueError, OverflowError):
        return None


def _plain(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, (bool, int, float, str, bytes)):
        return value
    return str(value)


class RosParameters:
    """Reads and sets parameters of the ROS parameter server. Its methods wait for the ROS master."""

    def __init__(self, master: Callable[[], Any], patterns: Sequence[str], operate: bool) -> None:
        """Initialise.

        Args:
            master: returns a connection to the master, such as a ``rosgraph.Master``.
            patterns: shell patterns of the parameters that clients may use.
            operate: whether clients may set them.
        """
        self._master = master
        self._patterns = tuple(patterns)
        self._operate = operate

    def get(self, names: Sequence[str]) -> list[Parameter]:
        """Return the named parameters, all without names; parameters that are not set are skipped."""
        values = flat(without_secrets(self._master().getParam("/")))
        chosen: Iterable[str] = names or sorted(values)
        found = (to_parameter(n, values[n]) for n in chosen if n in values and self._is_open(n))
        return [parameter for parameter in found if parameter is not None][:_MAX]

    def set(self, parameters: Iterable[Parameter]) -> list[Parameter]:
        """Set parameters, delete those without a value, and return the state after it.

        Raises:
            ParameterError: one is not allowed; the ones before it have been set.
        """
        names = []
        for parameter in parameters:
            name, value = parameter.name, parameter.get_value()
            self._check(name, value)
            if value is None:
                self._master().deleteParam(name)
            else:
                self._master().setParam(name, value)
                names.append(name)
        return self.get(names) if names else []

    def _check(self, name: str, value: Any) -> None:
        if not self._operate:
            raise ParameterError(f"parameter: {name} is not set: this bridge is read-only, see its parameter operate")
        try:
            absolute_name(name, "parameter")
        except RosNameError as error:
            raise ParameterError(str(error)) from error
        if not (name.startswith("/") and self._is_open(name)):
            raise ParameterError(f"parameter: {name!r} is not allowed, {', '.join(self._patterns)}, without tokens")
        if type(value) is int and not -_MAX_INTEGER <= value < _MAX_INTEGER:
            raise ParameterError(f"parameter: {name}: {value} is not allowed, 32 bits")

    def _is_open(self, name: str) -> bool:
        return not is_secret(name) and any(fnmatch.fnmatchcase(name, pattern) for pattern in self._patterns)
