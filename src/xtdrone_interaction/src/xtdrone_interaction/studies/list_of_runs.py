"""The runs of a study: every combination of parameters with every seed, each with a permanent key."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from xtdrone_coordination.patterns import PatternError, Patterns
from xtdrone_interaction.studies.study_file import AIRBORNE, Axis, Study
from xtdrone_interaction.studies.study_parameters import DEFAULTS, StudyError, Value, make_options

_KEY_LENGTH = 20  # hexadecimal digits: 80 bits


@dataclass(frozen=True)
class Run:
    """One flight of a study.

    Attributes:
        index: Index in the plan.
        key: Hash of everything that determines the result; the same in every study with this run.
        varied: Values of the varied parameters.
        seed: Seed of all random numbers.
    """

    index: int
    key: str
    varied: dict[str, Value]
    seed: int

    def task(self) -> dict[str, Any]:
        """Return the data for a worker, without those that all runs share."""
        return {"key": self.key, "varied": self.varied, "seed": self.seed}


class Plan(Sequence[Run]):
    """All runs of a study, created on access: all points with the first seed, then with the second, ...

    So an interrupted sweep has covered the whole range.
    """

    def __init__(self, study: Study) -> None:
        """Plan ``study``."""
        self.study = study
        self._base = json.dumps([study.base(), study.constants], sort_keys=True)
        self._names = [axis.parameter.name for axis in study.axes]

    def __len__(self) -> int:
        """Return the number of runs."""
        return self.study.runs

    def __getitem__(self, index: Any) -> Any:
        """Return the run of an index."""
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        if not 0 <= index < len(self):
            raise IndexError(index)
        seed_number, point = divmod(index, self.study.points)
        varied, seed = self.point(point), self.study.seeds[seed_number]
        return Run(index, self._key(varied, seed), varied, seed)

    def __iter__(self) -> Iterator[Run]:
        """Yield the runs in order."""
        return (self[index] for index in range(len(self)))

    def point(self, number: int) -> dict[str, Value]:
        """Return the parameters of a point, 0 to ``study.points`` - 1; the last parameter varies fastest."""
        axes = self.study.axes
        if self.study.combine in ("random", "latin"):
            return dict(zip(self._names, self._samples[number], strict=True))
        if self.study.combine == "zip":
            return {axis.parameter.name: axis.values[number] for axis in axes}
        values = []
        for axis in reversed(axes):
            number, place = divmod(number, len(axis.values))
            values.append((axis.parameter.name, axis.values[place]))
        return dict(reversed(values))

    def check(self) -> None:
        """Check that every combination of parameters can be flown.

        Raises:
            StudyError, PatternError: one cannot; the message names it.
        """
        study = self.study
        options: set[tuple[Any, ...]] = set()
        patterns: set[tuple[int, str, float]] = set()
        keys: dict[tuple[Any, ...], int] = {}
        for number in range(study.points):
            varied = self.point(number)
            values = tuple(varied.values())
            if values in keys:
                raise StudyError(
                    f"parameters: {_describe(varied)} is given twice, as points {keys[values]} and {number} of "
                    f"{study.points} (combine: {study.combine})"
                )
            keys[values] = number
            parameters = study.constants | varied
            own = DEFAULTS | parameters
            # a mission climbs as high as necessary
            altitude = float(own["altitude"]) if study.flight == AIRBORNE else math.inf
            patterns.add((int(own["n"]), str(own["patterns"]), altitude))
            options.add(tuple(sorted((k, v) for k, v in parameters.items() if "." in k or k == "kind")))
        for count, names, altitude in sorted(patterns):
            _check_patterns(count, names, altitude)
        for chosen in sorted(options, key=str):
            try:
                make_options(DEFAULTS | dict(chosen))
            except (ValueError, TypeError) as error:
                raise StudyError(f"parameters {_describe(dict(chosen))}: {error}") from error

    def _key(self, varied: dict[str, Value], seed: int) -> str:
        text = json.dumps([self._base, varied, seed], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:_KEY_LENGTH]

    @cached_property
    def _samples(self) -> list[tuple[Value, ...]]:
        study = self.study
        size = len(study.axes)
        if study.combine == "latin":
            from scipy.stats import qmc  # slow to import

            unit = qmc.LatinHypercube(size, seed=study.sample_seed).random(study.samples)
        else:
            unit = np.random.default_rng(study.sample_seed).random((study.samples, size))
        columns = [_draw(axis, unit[:, k]) for k, axis in enumerate(study.axes)]
        return list(zip(*columns, strict=True))


def _draw(axis: Axis, unit: Any) -> list[Value]:
    """Map numbers in [0, 1) to values of an axis."""
    if not axis.sampled:
        return [axis.values[int(u * len(axis.values))] for u in unit]
    start, end = float(axis.values[0]), float(axis.values[1])
    if axis.parameter.kind is int:
        low, high = int(min(start, end)), int(max(start, end))
        return [low + int(u * (high - low + 1)) for u in unit]
    if axis.log:
        return [float(f"{start * math.exp(u * math.log(end / start)):.12g}") for u in unit]
    return [float(f"{start + u * (end - start):.12g}") for u in unit]


def _check_patterns(count: int, names: str, altitude: float) -> None:
    patterns = Patterns(count)
    for name in dict.fromkeys(["origin", *names.split(",")]):
        lowest = altitude + float(patterns.offsets(name)[:, 2].min())
        if lowest < 1.0:
            raise PatternError(
                f"altitude: {altitude:g} m is not allowed with pattern {name!r} of {count} vehicles, whose lowest slot "
                f"lies {altitude - lowest:g} m below the leader; {1.0 + altitude - lowest:g} m or more"
            )


def _describe(values: dict[str, Value]) -> str:
    return ", ".join(f"{name}={value}" for name, value in values.items()) or "none"
