"""Formation patterns: where each follower's slot lies relative to the leader.

A pattern for N vehicles is an array of shape (N-1, 3): metres, ENU, row k for slot k+1; the leader (vehicle 0) is at
the origin. XTDrone's own patterns for 6, 9 and 18 vehicles are data (``config/patterns.yaml``); ``origin``, ``cube``,
``pyramid`` and ``triangle`` are generated for every other number, so that any swarm can fly them. So are the shapes of
``shapes``. What may be asked for, everywhere where a pattern is named::

    NAME                  a pattern of XTDrone or of the user's file; origin, cube, pyramid, triangle;
                          grid, circle, sphere (level, level, below the leader; 3 m apart)
    text:WORDS            upright letters, to be read from the south (-y); 2 m apart
    cloud:FILE            the points of a file: .ply, .npy, or text as .xyz and .csv; 2 m apart

    ...:spacing=METRES    as large as makes the least distance of two vehicles this, with every pattern
    ...:font=FILE         the text's font, TrueType or OpenType; else DejaVu Sans

as in ``circle``, ``sphere:spacing=5``, ``text:XTD``, ``text:12:30:spacing=2.5``, ``cloud:/data/bunny.ply``. Options
begin with a colon, their name and ``=``; what lies before them, colons included, is the text or the file. Lists of
patterns have commas between, so that none can stand in a text or a file's name there. A cloud's file has at most 16 MB.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_control import bounded_file

Offsets = NDArray[np.float64]

MIN_SEPARATION = 0.5  # m between any two slots: closer vehicles touch
MAX_SPACING = 1000.0  # m
_FLOAT32 = 2.0**-21  # offsets travel as 32-bit floats: by so much of the greatest a distance may shrink
PITCH = 3.0  # m, of the spawn grid, and the least distance in grid, circle and sphere
DENSE_PITCH = 2.0  # m, the least distance in letters and clouds


class PatternError(ValueError):
    """A pattern that does not exist or cannot be flown."""


class Patterns:
    """The patterns of one swarm; each is made when it is asked for, and kept.

    Attributes:
        count: number of vehicles N, the leader included.
    """

    def __init__(
        self,
        count: int,
        file: str | Path | None = None,
        *,
        below: str | Path | None = None,
        given: Collection[str] = (),
    ) -> None:
        """Collect XTDrone's patterns for ``count`` vehicles and those of a user's file.

        Args:
            count: N, at least 2.
            file: YAML with more patterns, ``{N: {name: [[x, y, z], ...]}}``; a name in it replaces ours.
            below: the folder below which clouds and fonts may lie, for names that come over topics; relative files
                begin in it, links are followed before it is looked where they lead. Empty: no file is read. None: files
                may lie anywhere.
            given: names whose files may lie anywhere all the same.

        Raises:
            PatternError: ``count`` is less than 2; the file is missing, malformed or holds a pattern of another size.
        """
        if count < 2:
            raise PatternError(f"number of vehicles: {count} is not allowed, a formation has at least 2")
        self.count = count
        self._below = below
        self._given = frozenset(given)
        self._tables = dict(_shipped_patterns(count))
        if file is not None:
            self._tables.update(read_patterns(Path(file), count))
        self._made: dict[str, Offsets] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the patterns that need no more than their name, XTDrone's first, in its order."""
        return tuple(dict.fromkeys([*self._tables, *_GENERATED, *_SHAPES]))

    def offsets(self, name: str) -> Offsets:
        """Return a copy of the slots of pattern ``name``, shape (N-1, 3), m ENU from the leader.

        Args:
            name: as the module's head says.

        Raises:
            PatternError: there is no such pattern for this number of vehicles, or it is asked for wrongly.
        """
        if name not in self._made:
            self._made[name] = self._make(name)
        return self._made[name].copy()

    def describe(self) -> str:
        """Return what there is as one line of text."""
        return ", ".join([*self.names, *(f"{name}:{needed}" for name, needed in _ARGUMENTS.items())])

    def __contains__(self, name: str) -> bool:
        """Return whether there is a pattern of this name; what follows a colon is not looked at."""
        kind = name.partition(":")[0]
        return any(kind in there for there in (self._tables, _GENERATED, _SHAPES, _ARGUMENTS)) or name in self._tables

    def _make(self, name: str) -> Offsets:
        if name in self._tables:
            return self._tables[name]
        if name not in self:
            raise PatternError(f"pattern {name!r} is unknown for {self.count} vehicles; there are: {self.describe()}")
        try:
            request = parse_name(name)
            return self._shape(request if name in self._given else self._restricted(request))
        except PatternError as error:
            raise PatternError(f"pattern {name!r}: {error}") from error

    def _restricted(self, request: Request) -> Request:
        """Return a request with the true paths of its files, all of them below the folder that is allowed."""
        if self._below is None:
            return request
        if request.kind == "cloud":
            request = replace(request, argument=self._allowed(request.argument))
        return request if request.font is None else replace(request, font=self._allowed(request.font))

    def _allowed(self, file: str) -> str:
        if not self._below:
            raise PatternError(
                f"{file}: no file may be read; name a folder of clouds and fonts when the leader starts (cloud_folder)"
            )
        folder = Path(str(self._below)).resolve()
        path = (folder / file).resolve()
        if not path.is_relative_to(folder):
            raise PatternError(f"{file}: is not allowed, a file below {folder} is (cloud_folder)")
        return str(path)

    def _shape(self, request: Request) -> Offsets:
        kind, spacing = request.kind, request.spacing
        if kind in self._tables or kind in _GENERATED:
            offsets = self._tables[kind] if kind in self._tables else _GENERATED[kind](self.count)
            return offsets if spacing is None else rescaled(offsets, spacing)
        from xtdrone_coordination import shapes  # a follower never needs it

        if kind in _SHAPES:
            make: Callable[[int, float], Offsets] = getattr(shapes, kind)
            return make(self.count, PITCH if spacing is None else spacing)
        spacing = DENSE_PITCH if spacing is None else spacing
        if kind == "cloud":
            return shapes.cloud(self.count, spacing, request.argument)
        return shapes.text(self.count, spacing, request.argument, request.font)


@dataclass(frozen=True)
class Request:
    """A pattern's name taken apart.

    Attributes:
        kind: what stands before the first colon.
        argument: words of a text, file of a cloud; else empty.
        spacing: least distance of two vehicles, m; None when it was not given.
        font: file of a text's font; None when it was not given.
    """

    kind: str
    argument: str = ""
    spacing: float | None = None
    font: str | None = None

    def __str__(self) -> str:
        """Return the name."""
        parts = [self.kind, *([self.argument] if self.argument else [])]
        parts += [f"font={self.font}"] if self.font is not None else []
        parts += [f"spacing={self.spacing:.12g}"] if self.spacing is not None else []
        return ":".join(parts)


def parse_name(name: str) -> Request:
    """Take a pattern's name apart; whether there is such a pattern is not looked at.

    Raises:
        PatternError: an argument or an option that is missing, unknown or not allowed.
    """
    kind, *parts = name.split(":")
    first = 1 if kind in _ARGUMENTS else 0  # the argument may look like an option
    begin = next((i for i in range(first, len(parts)) if _OPTION.match(parts[i])), len(parts))
    argument = ":".join(parts[:begin])
    if kind in _ARGUMENTS and not argument:
        raise PatternError(f"{kind} needs {_ARGUMENTS[kind]}, as {kind}:{_EXAMPLES[kind]}")
    if kind not in _ARGUMENTS and parts[:begin]:
        raise PatternError(f"{argument!r} is not allowed after {kind}, only spacing=METRES is")
    given: dict[str, str] = {}
    for part in parts[begin:]:
        if _OPTION.match(part):
            option, _, value = part.partition("=")
            given[option] = value
        else:  # a colon within a value
            given[option] += f":{part}"
    allowed = ("spacing", "font") if kind == "text" else ("spacing",)
    for option in given:
        if option not in allowed:
            raise PatternError(f"option {option!r} is unknown for {kind}; there are: {', '.join(allowed)}")
    spacing = _spacing(given["spacing"]) if "spacing" in given else None
    return Request(kind, argument, spacing, given.get("font"))


def absolute_name(name: str) -> str:
    """Return a pattern's name with whole paths of the files in it: its leader may run in another folder.

    What is no name of a text or a cloud comes back as it is.
    """
    try:
        request = parse_name(name)
    except PatternError:
        return name  # whoever makes the pattern says what is wrong
    if request.font is not None:
        request = replace(request, font=_absolute(request.font))
    elif request.kind != "cloud":
        return name
    return str(replace(request, argument=_absolute(request.argument)) if request.kind == "cloud" else request)


def _absolute(file: str) -> str:
    return str(Path(file).expanduser().absolute())


def _spacing(value: str) -> float:
    try:
        spacing = float(value)
    except ValueError:
        spacing = math.nan
    if not MIN_SEPARATION <= spacing <= MAX_SPACING:
        raise PatternError(f"spacing: {value!r} is not allowed, {MIN_SEPARATION} to {MAX_SPACING:g} m")
    return spacing


def shipped_file() -> Path:
    """Return the file of XTDrone's patterns, in the source tree or in the installed package."""
    source = Path(__file__).resolve().parents[2] / "config" / "patterns.yaml"
    if source.is_file():
        return source
    import rospkg  # only an installed package needs it

    return Path(rospkg.RosPack().get_path("xtdrone_coordination")) / "config" / "patterns.yaml"


@lru_cache(maxsize=16)
def _shipped_patterns(count: int) -> Mapping[str, Offsets]:
    return read_patterns(shipped_file(), count)


def read_patterns(file: Path, count: int) -> dict[str, Offsets]:
    """Return the patterns for ``count`` vehicles in a YAML file, empty when it has none for that number.

    Raises:
        PatternError: the file cannot be read, or a pattern in it is not N-1 rows of three finite numbers at least
            0.5 m apart from each other and from the leader.
    """
    try:
        data = bounded_file.load_yaml(bounded_file.read_text(file))
    except OSError as error:
        raise PatternError(f"pattern file {file}: {error.strerror or error}") from error
    except bounded_file.ContentError as error:
        raise PatternError(f"pattern file {file} is not YAML: {error}") from error
    if not isinstance(data, Mapping):
        raise PatternError(f"pattern file {file}: must be {{number of vehicles: {{name: offsets}}}}")
    for key in data:
        if isinstance(key, bool) or not isinstance(key, int):
            raise PatternError(
                f"pattern file {file}: {key!r} is no number of vehicles; "
                "must be {number of vehicles: {name: offsets}}"
            )
    section = data.get(count, {})
    if not isinstance(section, Mapping):
        raise PatternError(f"pattern file {file}: entry {count} must be {{name: offsets}}")
    return {str(name): check_offsets(rows, count, f"pattern {name!r} in {file}") for name, rows in section.items()}


def check_offsets(rows: Any, count: int, name: str) -> Offsets:
    """Return ``rows`` as an array of shape (count-1, 3).

    Args:
        rows: array-like, m ENU from the leader.
        count: number of vehicles N.
        name: what to call it in messages.

    Raises:
        PatternError: another shape, not finite, or two slots closer than 0.5 m.
    """
    try:
        offsets = np.array(rows, dtype=float)
    except (TypeError, ValueError) as error:
        raise PatternError(f"{name}: rows must be three numbers each ({error})") from error
    if offsets.shape != (count - 1, 3):
        shape = " x ".join(str(n) for n in offsets.shape)
        raise PatternError(f"{name}: size {shape}, but {count} vehicles need {count - 1} x 3")
    if not np.isfinite(offsets).all():
        raise PatternError(f"{name}: all offsets must be finite")
    separation = least_separation(offsets)
    if separation < MIN_SEPARATION - _FLOAT32 * float(np.abs(offsets).max()):
        raise PatternError(f"{name}: two vehicles are {separation:.2f} m apart, at least {MIN_SEPARATION} m is allowed")
    return offsets


def least_separation(offsets: Offsets) -> float:
    """Return the least distance in metres between any two vehicles of a pattern, the leader at the origin included.

    The vehicles are put in order along a line that is oblique to all usual lattices; each is compared with the next,
    the next but one, ..., until along the line all are farther apart than the nearest two found so far.
    """
    points = with_leader(offsets)
    along = points @ _OBLIQUE
    order = np.argsort(along, kind="stable")
    points, along = points[order], along[order]
    first = np.arange(len(points))
    least = math.inf
    for step in range(1, len(points)):
        first = first[first < len(points) - step]
        first = first[along[first + step] - along[first] <= least * _ROUNDING]
        if not len(first):
            break
        distances = np.linalg.norm(points[first + step] - points[first], axis=1)
        least = min(least, float(distances.min()))
    return least


_OBLIQUE = np.array([0.7834, 0.5283, 0.3271])  # about a unit vector, and shorter rather than longer
_ROUNDING = 1.0 + 1e-9


def rescaled(offsets: Offsets, spacing: float) -> Offsets:
    """Return the same pattern in the size that puts its nearest two vehicles ``spacing`` metres apart."""
    return offsets * (spacing / least_separation(offsets))


def with_leader(offsets: Offsets) -> Offsets:
    """Return the offsets of all N vehicles, shape (N, 3): the leader's zero row before the followers'."""
    return np.vstack([np.zeros(3), offsets])


def origin_columns(count: int) -> int:
    """Return how many vehicles stand side by side along x in the pattern ``origin``, which is the spawn grid."""
    return {6: 2, 9: 3, 18: 3}.get(count, max(1, round(math.sqrt(count))))


def _origin(count: int) -> Offsets:
    """The spawn grid, filled along x first."""
    columns = origin_columns(count)
    return np.array([(PITCH * (i % columns), PITCH * (i // columns), 0.0) for i in range(1, count)])


def _cube(count: int) -> Offsets:
    """A cubic lattice around the leader, as small as holds all followers, filled from its corners inwards."""
    side = 2
    while side**3 - side % 2 < count - 1:  # the middle of an odd lattice is the leader's
        side += 1
    pitch = 4.0 if side == 2 else PITCH
    axis = [pitch * (k - (side - 1) / 2) for k in range(side)]
    points = [(x, y, z) for z in reversed(axis) for y in axis for x in axis if (x, y, z) != (0.0, 0.0, 0.0)]
    points.sort(key=lambda p: -(p[0] ** 2 + p[1] ** 2 + p[2] ** 2))  # stable: upper layers first
    return np.array(points[: count - 1])


def _pyramid(count: int) -> Offsets:
    """Square rings below the leader: layer k at z = -2k has side 4k and a vehicle every 4 m, corners first."""
    points: list[tuple[float, float, float]] = []
    layer = 0
    while len(points) < count - 1:
        layer += 1
        half = 2.0 * layer
        steps = [4.0 * k - half for k in range(layer)]  # one side without its last corner
        ring = [p for s in steps for p in ((s, -half), (half, s), (-s, half), (-half, -s))]
        points += [(x, y, -2.0 * layer) for x, y in ring]
    return np.array(points[: count - 1])


def _triangle(count: int) -> Offsets:
    """An upright triangle in the y-z plane: row k at z = -2k has 2k+1 vehicles 2 m apart, filled from its middle."""
    points: list[tuple[float, float, float]] = []
    row = 0
    while len(points) < count - 1:
        row += 1
        points += [(0.0, 2.0 * y, -2.0 * row) for y in sorted(range(-row, row + 1), key=abs)]
    return np.array(points[: count - 1])


_GENERATED: dict[str, Callable[[int], Offsets]] = {
    "origin": _origin,
    "cube": _cube,
    "pyramid": _pyramid,
    "triangle": _triangle,
}

_SHAPES = ("grid", "circle", "sphere")  # functions of shapes with nothing but a number and a spacing
_ARGUMENTS = {"text": "WORDS", "cloud": "FILE"}
_EXAMPLES = {"text": "XTD", "cloud": "/data/points.ply"}
_OPTION = re.compile(r"[a-z_]+=")
