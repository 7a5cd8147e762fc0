"""A study: the flight, its varied parameters and its seeds, read from YAML and checked.

::

    name: gains
    engine: simplified            # or core: full physics without ROS
    constants: {n: 9, pattern: cube}
    parameters:
      follower.Kp: {from: 0.5, to: 2.0, steps: 4, log: true}
      follower.vel_max: [0.5, 1.0, 2.0]
    combine: grid                 # or zip, random, latin
    seeds: 10                     # 0 to 9, or a list
    follower: my_follower.py:MyFollower
    metric: my_metric.py:figures
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from xtdrone_common.files import BoundedLoader, ContentError, load_yaml, read_text
from xtdrone_common.settings import SettingError, check_choice
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_interaction.studies import study_parameters, user_code
from xtdrone_interaction.studies.study_parameters import Parameter, StudyError, Value
from xtdrone_interaction.studies.user_code import Source

ENGINES = ("simplified", "core")
AIRBORNE, MISSION = "airborne", "mission"
FLIGHTS = (AIRBORNE, MISSION)
_OF_AIRBORNE = ("altitude", "hold", "limit")
COMBINATIONS = ("grid", "zip", "random", "latin")
MOST_RUNS = 1_000_000
_MOST_SEED = 2**31 - 1
_KEYS = (
    "name", "note", "engine", "flight", "constants", "parameters", "combine", "samples", "sample_seed", "seeds",
    "follower", "leader", "metric",
)  # fmt: skip
_ROLES: dict[str, type | None] = {"follower": Follower, "leader": Leader, "metric": None}


@dataclass(frozen=True)
class Axis:
    """One varied parameter.

    Attributes:
        parameter: the parameter.
        values: in order; both ends of a sampled range.
        log: whether values are spaced or sampled evenly in the logarithm.
        sampled: whether values are drawn at random between both ends.
    """

    parameter: Parameter
    values: tuple[Value, ...]
    log: bool = False
    sampled: bool = False


@dataclass(frozen=True)
class Study:
    """A checked study.

    Attributes:
        name: also of the results folder.
        engine: ``simplified`` or ``core``.
        flight: ``airborne`` (patterns only, from the air) or ``mission`` (takeoff to landing, as in the demo).
        constants: parameters with one value, by name.
        axes: varied parameters.
        combine: combination of axes: ``grid``, ``zip``, ``random`` or ``latin``.
        samples: number of points of ``random`` and ``latin``, 0 otherwise.
        sample_seed: of these points.
        seeds: of the runs at each point.
        sources: user's Python by role: follower, leader, metric.
        known: all available parameters.
    """

    name: str
    engine: str
    flight: str
    constants: dict[str, Value]
    axes: tuple[Axis, ...]
    combine: str
    samples: int
    sample_seed: int
    seeds: tuple[int, ...]
    sources: dict[str, Source] = field(default_factory=dict)
    known: dict[str, Parameter] = field(default_factory=dict)

    @property
    def points(self) -> int:
        """Number of parameter combinations."""
        if not self.axes:
            return 1
        if self.combine in ("random", "latin"):
            return self.samples
        if self.combine == "zip":
            return len(self.axes[0].values)
        return math.prod(len(axis.values) for axis in self.axes)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return self.points * len(self.seeds)

    def base(self) -> dict[str, Any]:
        """Return the data that determine a run beside its parameters and seed."""
        return {
            "engine": self.engine,
            "flight": self.flight,
            "sources": {role: source.digest for role, source in sorted(self.sources.items())},
        }

    def plain(self) -> dict[str, Any]:
        """Return the study as JSON data."""
        return {
            "name": self.name,
            **self.base(),
            "constants": self.constants,
            "parameters": {axis.parameter.name: _plain_axis(axis) for axis in self.axes},
            "combine": self.combine,
            "samples": self.samples,
            "sample_seed": self.sample_seed,
            "seeds": list(self.seeds),
        }


def _plain_axis(axis: Axis) -> Any:
    return {"from": axis.values[0], "to": axis.values[1], "log": axis.log} if axis.sampled else list(axis.values)


class _Loader(BoundedLoader):
    """YAML loader that rejects duplicate keys, of which YAML silently takes the last."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                continue  # rejected below
            if key in seen:
                raise ContentError(f"{key!r} is given twice, again in line {key_node.start_mark.line + 1}")
            seen.add(key)
        return super().construct_mapping(node, deep)


def read_study(file: str | Path) -> Study:
    """Read and check a study.

    Raises:
        StudyError: unreadable file or invalid study; the message names the file.
    """
    path = Path(file)
    try:
        text = read_text(path)
        return make_study(load_yaml(text, _Loader), path.resolve().parent)
    except OSError as error:
        raise StudyError(f"study: {path}: {error.strerror or error}") from error
    except ContentError as error:
        raise StudyError(f"study: {path} is not YAML: {error}") from error
    except (StudyError, SettingError) as error:
        raise StudyError(f"study {path}: {error}") from error


class _Checks:
    """Checks of entries that do not depend on each other, so that all their errors are reported at once."""

    def __init__(self) -> None:
        self._errors: list[str] = []

    def add(self, error: str) -> None:
        """Report an error."""
        self._errors.append(error)

    def __call__(self, make: Callable[[], Any]) -> Any:
        """Return the result of a check; None, and its error kept, if it fails."""
        try:
            return make()
        except (StudyError, SettingError) as error:
            self.add(str(error))
            return None

    def end(self) -> None:
        """Raise an StudyError with all errors, if there are any."""
        if self._errors:
            raise StudyError("; ".join(self._errors))


def make_study(data: object, folder: Path) -> Study:
    """Create a study from YAML data.

    Args:
        data: from the YAML file.
        folder: base of relative paths.

    Raises:
        StudyError: invalid study.
    """
    if data is None:
        raise StudyError(f"it is empty; a mapping with {', '.join(_KEYS)}")
    if not isinstance(data, Mapping):
        raise StudyError(f"{str(data)[:60]} is not a study; a mapping with {', '.join(_KEYS)}")
    check = _Checks()
    for key in (key for key in data if key not in _KEYS):
        check.add(f"{key!r} is unknown; there are: {', '.join(_KEYS)}")
    found, attributes = _read_sources(data, folder)
    known = study_parameters.known_parameters(attributes)
    name = check(lambda: _check_name(data.get("name")))
    combine = check(lambda: check_choice("combine", data.get("combine", "grid"), COMBINATIONS)) or "grid"
    engine = check(lambda: check_choice("engine", data.get("engine", "simplified"), ENGINES))
    usual = MISSION if engine == "core" else AIRBORNE
    flight = check(lambda: check_choice("flight", data.get("flight", usual), FLIGHTS))
    seeds = check(lambda: _read_seeds(data.get("seeds", 1)))
    sample_seed = check(lambda: _check_whole("sample_seed", data.get("sample_seed", 0), 0, _MOST_SEED))
    varied = check(lambda: _check_mapping("parameters", data.get("parameters"))) or {}
    constants = check(lambda: _check_mapping("constants", data.get("constants"))) or {}
    for key in (*varied, *constants):
        check(partial(study_parameters.find_parameter, key, known))
    check.end()
    axes = _read_axes(varied, known, combine)
    study = Study(
        name=name,
        engine=engine,
        flight=flight,
        constants=_read_constants(constants, known, axes),
        axes=axes,
        combine=combine,
        samples=_read_samples(data, combine, axes),
        sample_seed=sample_seed,
        seeds=seeds,
        sources=found,
        known=known,
    )
    _check_fit(study)
    if study.runs > MOST_RUNS:
        sizes = " x ".join(str(len(axis.values)) for axis in axes) if combine == "grid" else str(study.points)
        raise StudyError(
            f"the study has {study.runs:,} runs ({sizes} points x {len(study.seeds)} seeds); {MOST_RUNS:,} at most"
        )
    return study


def _check_fit(study: Study) -> None:
    """Reject parameters without any effect in this engine or flight."""
    used = [*study.constants, *(axis.parameter.name for axis in study.axes)]
    if study.engine == "core" and study.flight != MISSION:
        raise StudyError(
            f"flight: {study.flight!r} is not allowed with engine core, which begins on the ground; mission"
        )
    for name in used:
        if study.flight == MISSION and name in _OF_AIRBORNE:
            raise StudyError(f"{name!r} has no effect in flight mission; leave it out, or use flight: airborne")
        if study.engine == "core" and name.startswith("model."):
            raise StudyError(f"{name!r} has no effect in engine core, which is full physics; use engine: simplified")


def _read_sources(data: Mapping[str, Any], folder: Path) -> tuple[dict[str, Source], dict[str, Any]]:
    """Return the user's Python by role, and the settable attributes of the follower's class."""
    found = {role: user_code.read_source(role, data[role], folder) for role in _ROLES if role in data}
    attributes: dict[str, Any] = {}
    for role, source in found.items():
        loaded, base = user_code.load(role, source), _ROLES[role]
        if base is None and not callable(loaded):
            raise StudyError(f"{role}: {source.name!r} in {source.path} is not a function")
        if base is not None and not (isinstance(loaded, type) and issubclass(loaded, base)):
            raise StudyError(f"{role}: {source.name!r} in {source.path} is not a subclass of {base.__name__}")
        if role == "follower":
            attributes = dict(user_code.class_attributes(loaded))
    return found, attributes


def _check_name(value: object) -> str:
    allowed = isinstance(value, str) and 0 < len(value) <= 64 and value.replace("-", "").replace("_", "").isalnum()
    if not allowed or not isinstance(value, str) or value.startswith("-"):
        raise SettingError("name", value, "up to 64 letters, digits, - and _")
    return value


def _check_mapping(key: str, value: object) -> Mapping[Any, Any]:
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        raise SettingError(key, value, "a mapping of parameters' names")
    return value


def _check_whole(key: str, value: object, least: int, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise SettingError(key, value, f"a whole number from {least} to {most}")
    return value


def _read_samples(data: Mapping[str, Any], combine: str, axes: Sequence[Axis]) -> int:
    if combine not in ("random", "latin"):
        for key in ("samples", "sample_seed"):
            if key in data:
                raise StudyError(f"{key}: needs combine: random or latin, not {combine}")
        return 0
    if not axes:
        raise StudyError(f"combine: {combine} needs parameters to draw, there are none")
    return _check_whole("samples", data.get("samples"), 1, MOST_RUNS)


def _read_seeds(value: object) -> tuple[int, ...]:
    if isinstance(value, list):
        if not value:
            raise StudyError("seeds: the list is empty; at least one seed")
        seeds = tuple(_check_whole("seeds", seed, 0, _MOST_SEED) for seed in value)
        _check_unique("seeds", seeds)
        return seeds
    return tuple(range(_check_whole("seeds", value, 1, MOST_RUNS)))


def _check_unique(name: str, values: Sequence[Value]) -> None:
    seen: set[Value] = set()
    for value in values:
        if value in seen:
            raise StudyError(f"{name}: {value!r} is given twice")
        seen.add(value)


def _read_constants(
    data: Mapping[Any, Any], known: Mapping[str, Parameter], axes: Sequence[Axis]
) -> dict[str, Value]:  # fmt: skip
    varied = {axis.parameter.name for axis in axes}
    found: dict[str, Value] = {}
    for name, value in data.items():
        parameter = study_parameters.find_parameter(name, known)
        if parameter.name in found:
            raise StudyError(f"constants: {parameter.name!r} is given twice, once by another name")
        if parameter.name in varied:
            raise StudyError(f"{parameter.name!r} is both a constant and a varied parameter")
        found[parameter.name] = parameter.check(value)
    return found


def _read_axes(data: Mapping[Any, Any], known: Mapping[str, Parameter], combine: str) -> tuple[Axis, ...]:
    axes = tuple(_read_axis(study_parameters.find_parameter(name, known), spec, combine) for name, spec in data.items())
    _check_unique("parameters", [axis.parameter.name for axis in axes])
    if combine == "zip":
        sizes = {axis.parameter.name: len(axis.values) for axis in axes}
        if len(set(sizes.values())) > 1:
            text = ", ".join(f"{name} {size}" for name, size in sizes.items())
            raise StudyError(f"combine: zip needs parameters of equal length, they have: {text}")
    return axes


def _read_axis(parameter: Parameter, spec: object, combine: str) -> Axis:
    if isinstance(spec, Mapping):
        return _read_range(parameter, spec, combine)
    if not isinstance(spec, list):
        raise StudyError(
            f"{parameter.name}: {spec!r} is not allowed; a list, or {{from, to, steps}} (one value goes to constants)"
        )
    if not spec:
        raise StudyError(f"{parameter.name}: the list of values is empty")
    values = tuple(parameter.check(value) for value in spec)
    if combine != "zip":  # zip has no duplicates unless whole points are equal
        _check_unique(parameter.name, values)
    return Axis(parameter, values)


def _read_range(parameter: Parameter, spec: Mapping[Any, Any], combine: str) -> Axis:
    sampled, name = combine in ("random", "latin"), parameter.name
    allowed = ("from", "to", "log") if sampled else ("from", "to", "steps", "log")
    for key in spec:
        if key not in allowed:
            why = f" with combine: {combine}" if key == "steps" else ""
            raise StudyError(f"{name}: {key!r} is unknown in a range{why}; there are: {', '.join(allowed)}")
    for key in allowed[:-1]:
        if key not in spec:
            raise StudyError(f"{name}: the range has no {key!r}")
    if parameter.kind not in (int, float):
        raise StudyError(f"{name}: a range is for numbers only, not for {parameter.kind.__name__}")
    log = spec.get("log", False)
    if not isinstance(log, bool):
        raise StudyError(f"{name}: log: {log!r} is not allowed; true or false")
    start, end = float(parameter.check(spec["from"])), float(parameter.check(spec["to"]))
    if math.isinf(start) or math.isinf(end) or start == end:
        raise StudyError(f"{name}: the range from {start:g} to {end:g} is not allowed; two different, finite numbers")
    if log and min(start, end) <= 0.0:
        raise StudyError(f"{name}: a logarithmic range from {start:g} to {end:g}; both must be above 0")
    if sampled:
        return Axis(parameter, (parameter.check(start), parameter.check(end)), log, sampled=True)
    steps = _check_whole(f"{name}: steps", spec["steps"], 2, MOST_RUNS)
    numbers = np.geomspace(start, end, steps) if log else np.linspace(start, end, steps)
    # Twelve digits: 0.3 on every machine rather than 0.30000000000000004.
    values = tuple(parameter.check(float(f"{number:.12g}")) for number in numbers)
    _check_unique(name, values)
    return Axis(parameter, values, log)
