"""Parameters of a study: those of the flight, and the settings of followers, leader, vehicles and network."""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from xtdrone_coordination.follower import FollowerOptions
from xtdrone_coordination.leader import LeaderOptions
from xtdrone_coordination.network import NetworkOptions
from xtdrone_interaction.command_options import MAX_SWARM, OptionError
from xtdrone_swarm import Model

Value = bool | int | float | str

GROUPS: dict[str, type] = {
    "follower": FollowerOptions,
    "leader": LeaderOptions,
    "model": Model,
    "network": NetworkOptions,
}
"""Classes whose fields are parameters, such as ``follower.Kp``."""
CLASS = "class."
"""Prefix of parameters that are class attributes of the user's follower."""
_ALIASES = {"pattern": "patterns"}


@dataclass(frozen=True)
class Parameter:
    """A parameter and its allowed values.

    Attributes:
        name: in a study.
        kind: bool, int, float or str.
        choices: allowed texts; empty for any.
        least: lower limit, or None.
        most: upper limit, or None.
        infinite: whether ``.inf`` is allowed.
    """

    name: str
    kind: type
    choices: tuple[str, ...] = ()
    least: float | None = None
    most: float | None = None
    infinite: bool = False

    def check(self, value: object) -> Value:
        """Convert ``value`` to the parameter's type.

        Raises:
            OptionError: invalid value.
        """
        if self.kind is bool:
            if isinstance(value, bool):
                return value
            raise self._refused(value, "true or false")
        if self.kind is str:
            if isinstance(value, str) and value and (not self.choices or value in self.choices):
                return value
            raise self._refused(value, f"one of {', '.join(self.choices)}" if self.choices else "a text")
        return self._number(value)

    def _number(self, value: object) -> Value:
        number = as_number(value)
        whole = "whole number" if self.kind is int else "number"
        if number is None or math.isnan(number) or (math.isinf(number) and not (self.infinite and number > 0)):
            raise self._refused(value, f"a finite {whole}" + (" or .inf" if self.infinite else ""))
        if self.kind is int and not number.is_integer():
            raise self._refused(value, "a whole number")
        if self.least is not None and number < self.least:
            raise self._refused(value, f"{self.least:g} or more")
        if self.most is not None and number > self.most:
            raise self._refused(value, f"{self.most:g} or less")
        return int(number) if self.kind is int else number + 0.0  # -0.0 and 0.0 are one value

    def _refused(self, value: object, allowed: str) -> OptionError:
        return OptionError(f"{self.name}: {value!r} is not allowed; {allowed}")


class PatternList(Parameter):
    """Patterns that a flight flies in turn, stored as comma-separated names."""

    def check(self, value: object) -> Value:
        """Return comma-separated names.

        Raises:
            OptionError: not a list of names.
        """
        names = value if isinstance(value, list) else value.split(",") if isinstance(value, str) else []
        if not names or not all(isinstance(name, str) and name.strip() for name in names):
            raise self._refused(value, "a pattern's name, or a list of names")
        return ",".join(name.strip() for name in names)


_FLIGHT = (
    Parameter("n", int, least=2, most=MAX_SWARM),
    PatternList("patterns", str),
    Parameter("kind", str),
    Parameter("altitude", float, least=1.0, most=1000.0),
    Parameter("scatter", float, least=0.0, most=1.0),
    Parameter("hold", float, least=0.0, most=600.0),
    Parameter("limit", float, least=1.0, most=3600.0),
)
DEFAULTS: dict[str, Value] = {
    "n": 9,
    "patterns": "cube,pyramid,triangle",
    "kind": "iris",
    "altitude": 15.0,
    "scatter": 0.5,
    "hold": 5.0,
    "limit": 60.0,
}
"""Default values of the flight's parameters."""


def as_number(value: object) -> float | None:
    """Convert a number or its text (YAML reads 1e-3 as a text) to float; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        return float(value)
    except (ValueError, OverflowError):
        return None


def known_parameters(attributes: Mapping[str, object] | None = None) -> dict[str, Parameter]:
    """Return all parameters by name.

    Args:
        attributes: class attributes of the user's follower that are numbers, booleans or texts.
    """
    found = {parameter.name: parameter for parameter in _FLIGHT}
    for group, options in GROUPS.items():
        hints = typing.get_type_hints(options)
        for field in dataclasses.fields(options):
            parameter = _of_field(f"{group}.{field.name}", hints[field.name])
            if parameter is not None:
                found[parameter.name] = parameter
    for name, value in (attributes or {}).items():
        found[CLASS + name] = Parameter(CLASS + name, type(value) if isinstance(value, bool | str) else float)
    return found


def _of_field(name: str, hint: Any) -> Parameter | None:
    """Return the parameter of a data class's field; None unless it is a number, boolean or text."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
        hint = kinds[0] if len(kinds) == 1 else None
    if typing.get_origin(hint) is Literal:
        choices = typing.get_args(hint)
        if all(isinstance(choice, str) for choice in choices):
            return Parameter(name, str, choices)
        return Parameter(name, int, least=min(choices), most=max(choices))
    if hint not in (bool, int, float, str):
        return None
    # The class itself rejects infinity where it makes no sense.
    return Parameter(name, hint, infinite=hint is float)


def find_parameter(name: object, known: Mapping[str, Parameter]) -> Parameter:
    """Return a parameter by its name in a study.

    Raises:
        OptionError: unknown name; the message suggests similar ones.
    """
    text = _ALIASES.get(str(name), str(name))
    if text in known:
        return known[text]
    near = [other for other in known if other.rpartition(".")[2] == text]
    near = near or difflib.get_close_matches(text, known, 3)
    hint = f"did you mean {' or '.join(near)}?" if near else "there are: " + describe(known)
    raise OptionError(f"parameter {text!r} is unknown; {hint}")


def describe(names: Sequence[str] | Mapping[str, Parameter]) -> str:
    """Return the names in one line."""
    return ", ".join(names)


def group_of(parameters: Mapping[str, Value], group: str) -> dict[str, Value]:
    """Return the parameters of a group without its prefix, such as ``{"Kp": 1.0}`` of ``follower``."""
    start = group + "."
    return {name[len(start) :]: value for name, value in parameters.items() if name.startswith(start)}
