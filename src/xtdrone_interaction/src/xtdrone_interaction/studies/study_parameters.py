"""Parameters of a study: those of the flight, and the settings of followers, leader, vehicles and network."""

from __future__ import annotations

import dataclasses
import difflib
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from xtdrone_common.settings import SettingError, Settings, setting
from xtdrone_coordination.follower import FollowerOptions
from xtdrone_coordination.leader import LeaderOptions
from xtdrone_coordination.network import NetworkOptions
from xtdrone_swarm import Model
from xtdrone_swarm.simplified.vehicle_parameters import load_model
from xtdrone_swarm.swarm import MOST_VEHICLES

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


class StudyError(ValueError):
    """A study cannot be flown, or its results not be used; the message names the thing and the reason."""


def _join_patterns(value: object) -> str:
    """Return comma-separated names of patterns from a list of names, or from names with commas between."""
    names = value if isinstance(value, list) else value.split(",") if isinstance(value, str) else []
    if not names or not all(isinstance(name, str) and name.strip() for name in names):
        raise ValueError("a pattern's name, or a list of names")
    return ",".join(name.strip() for name in names)


@dataclass(frozen=True)
class FlightOptions(Settings):
    """The flight of a run; ``altitude``, ``hold`` and ``limit`` are of airborne flights."""

    n: int = setting(9, low=2, high=MOST_VEHICLES, text="number of vehicles")
    patterns: str = setting("cube,pyramid,triangle", parse=_join_patterns, text="patterns that are flown in turn")
    kind: str = setting("iris", text="type of the vehicles")
    altitude: float = setting(15.0, low=1.0, high=1000.0, unit="m", text="height of the start over the ground")
    scatter: float = setting(0.5, low=0.0, high=1.0, unit="m", text="largest offset of a start along x and y")
    hold: float = setting(5.0, low=0.0, high=600.0, unit="s", text="time within the tolerance that counts as settled")
    limit: float = setting(60.0, low=1.0, high=3600.0, unit="s", text="longest flight of a pattern")


DEFAULTS: dict[str, Value] = dataclasses.asdict(FlightOptions())
"""Default values of the flight's parameters."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of a study.

    Attributes:
        name: Name in a study.
        kind: bool, int, float or str.
        options: Class with the declaration of its setting; None without one.
    """

    name: str
    kind: type
    options: type[Settings] | None = None

    def check(self, value: object) -> Value:
        """Return ``value`` in the parameter's type; YAML reads numbers such as 1e-3 as a text.

        Raises:
            SettingError: it is not allowed.
        """
        number = as_number(value) if self.kind in (int, float) else None
        if number is not None:
            value = int(number) if self.kind is int and number.is_integer() else number + 0.0  # -0.0 and 0.0 are one
        if self.options is not None:
            field = self.name.rpartition(".")[2]
            try:
                checked: Value = getattr(self.options.from_mapping({field: value}, self.name), field)
            except SettingError as error:
                raise SettingError(self.name, error.value, error.allowed) from error
            return checked
        if not isinstance(value, self.kind) or value == "" or value != value:
            allowed = {bool: "true or false", str: "a text"}.get(self.kind, "a number")
            raise SettingError(self.name, value, allowed)
        assert isinstance(value, bool | int | float | str)
        return value


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
        attributes: Class attributes of the user's follower that are numbers, booleans or texts.
    """
    hints = typing.get_type_hints(FlightOptions)
    found = [Parameter(name, hints[name], FlightOptions) for name in DEFAULTS]
    for group, options in GROUPS.items():
        hints = typing.get_type_hints(options)
        for field in dataclasses.fields(options):
            kind = _find_kind(hints[field.name])
            if kind is not None:
                found.append(Parameter(f"{group}.{field.name}", kind, _isolate(field) if field.metadata else None))
    for name, value in (attributes or {}).items():
        found.append(Parameter(CLASS + name, type(value) if isinstance(value, bool | str) else float))
    return {parameter.name: parameter for parameter in found}


def _find_kind(hint: Any) -> type | None:
    """Return the type of a field's values; None unless they are numbers, booleans or texts."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(hint) if kind is not type(None)]
        hint = kinds[0] if len(kinds) == 1 else None
    if typing.get_origin(hint) is typing.Literal:
        hint = type(typing.get_args(hint)[0])
    return hint if hint in (bool, int, float, str) else None


def _isolate(field: dataclasses.Field[Any]) -> type[Settings]:
    """Return a class with this setting only: a value is checked alone when it is read, combinations later."""
    alone = dataclasses.field(default=field.default, metadata=field.metadata)
    return dataclasses.make_dataclass(field.name, [(field.name, field.type, alone)], bases=(Settings,), frozen=True)


def make_options(parameters: Mapping[str, Value]) -> dict[str, Any]:
    """Return the settings of follower, leader, model and network; network is None without network parameters.

    Raises:
        ValueError: invalid combination.
    """
    network, model = group_of(parameters, "network"), group_of(parameters, "model")
    return {
        "follower": FollowerOptions(**group_of(parameters, "follower")),  # type: ignore[arg-type]
        "leader": LeaderOptions(**group_of(parameters, "leader")),  # type: ignore[arg-type]
        "model": dataclasses.replace(load_model(str(parameters["kind"])), **model),  # type: ignore[arg-type]
        "network": NetworkOptions(**network) if network else None,  # type: ignore[arg-type]
    }


def find_parameter(name: object, known: Mapping[str, Parameter]) -> Parameter:
    """Return a parameter by its name in a study.

    Raises:
        StudyError: unknown name; the message suggests similar ones.
    """
    text = _ALIASES.get(str(name), str(name))
    if text in known:
        return known[text]
    near = [other for other in known if other.rpartition(".")[2] == text]
    near = near or difflib.get_close_matches(text, known, 3)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are: {', '.join(known)}"
    raise StudyError(f"parameter {text!r} is unknown; {hint}")


def group_of(parameters: Mapping[str, Value], group: str) -> dict[str, Value]:
    """Return the parameters of a group without its prefix, such as ``{"Kp": 1.0}`` of ``follower``."""
    start = group + "."
    return {name[len(start) :]: value for name, value in parameters.items() if name.startswith(start)}
