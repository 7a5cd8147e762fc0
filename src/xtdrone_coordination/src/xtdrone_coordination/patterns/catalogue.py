"""All patterns that one swarm can fly, and the files that define them.

A pattern is known by its name. XTDrone's own patterns for 6, 9 and 18 vehicles are data (``config/patterns.yaml``);
``origin``, ``cube``, ``pyramid`` and ``triangle`` are generated for every other number of vehicles, as are the shapes::

    NAME                  a pattern of XTDrone or of the user's file; origin, cube, pyramid, triangle;
                          grid, circle, sphere (level, level, below the leader; 3 m apart)
    text:WORDS            upright letters, read from the south (-y); 2 m apart
    cloud:FILE            the points of a file: .ply, .npy, or text such as .xyz and .csv; 2 m apart

    ...:spacing=METRES    scales any pattern to this minimum distance between two vehicles
    ...:font=FILE         font of the text, TrueType or OpenType; by default DejaVu Sans

for instance ``circle``, ``sphere:spacing=5``, ``text:XTD``, ``text:12:30:spacing=2.5``, ``cloud:/data/bunny.ply``.
Options start with a colon, their name and ``=``; the text or file before them may contain colons. Lists of patterns are
separated by commas, which therefore cannot occur in a text or file name there. The file of a cloud has at most 16 MB.

The leader is one of the N vehicles of a shape: the highest, so that the others hang below it, and the most central one
among equally high vehicles. The same arguments give the same slots, to the bit.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from xtdrone_common import files

from .clouds import cloud
from .generated import FAMILIES, SHAPES
from .letters import text
from .names import ARGUMENTS, PatternRequest, parse_name
from .slot_offsets_and_spacing import DENSE_PITCH, PITCH, Offsets, PatternError, check_offsets, rescaled


class Patterns:
    """The patterns of one swarm; each is created on first use and cached.

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
        """Load XTDrone's patterns for ``count`` vehicles and those of a user's file.

        Args:
            count: N, at least 2.
            file: YAML with more patterns, ``{N: {name: [[x, y, z], ...]}}``; its names take precedence.
            below: folder that must contain the files of clouds and fonts, for names received over topics; relative
                paths start in it, links are resolved before the check. Empty: no file is read. None: no restriction.
            given: names exempt from this restriction.

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
        """Names of the patterns without arguments, XTDrone's first, in its order."""
        return tuple(dict.fromkeys([*self._tables, *FAMILIES, *SHAPES]))

    def offsets(self, name: str) -> Offsets:
        """Return a copy of the slots of pattern ``name``, shape (N-1, 3), m ENU from the leader.

        Args:
            name: see the head of this module.

        Raises:
            PatternError: there is no such pattern for this number of vehicles, or its arguments are wrong.
        """
        if name not in self._made:
            self._made[name] = self._make(name)
        return self._made[name].copy()

    def describe(self) -> str:
        """Return all names as one line of text."""
        return ", ".join([*self.names, *(f"{name}:{needed}" for name, needed in ARGUMENTS.items())])

    def __contains__(self, name: str) -> bool:
        """Return whether there is a pattern of this name; the part after a colon is ignored."""
        kind = name.partition(":")[0]
        return any(kind in there for there in (self._tables, FAMILIES, SHAPES, ARGUMENTS)) or name in self._tables

    def _make(self, name: str) -> Offsets:
        if name in self._tables:
            return self._tables[name]
        if name not in self:
            raise PatternError(f"pattern {name!r} is unknown for {self.count} vehicles; there are: {self.describe()}")
        try:
            request = parse_name(name)
            return self._shape(request if name in self._given else self._restrict(request))
        except PatternError as error:
            raise PatternError(f"pattern {name!r}: {error}") from error

    def _restrict(self, request: PatternRequest) -> PatternRequest:
        """Return a request with resolved paths of its files, all of them inside the allowed folder."""
        if self._below is None:
            return request
        if request.kind == "cloud":
            request = replace(request, argument=self._resolve(request.argument))
        return request if request.font is None else replace(request, font=self._resolve(request.font))

    def _resolve(self, file: str) -> str:
        if not self._below:
            raise PatternError(
                f"{file}: no file may be read; name a folder of clouds and fonts when the leader starts (cloud_folder)"
            )
        folder = Path(str(self._below)).resolve()
        path = (folder / file).resolve()
        if not path.is_relative_to(folder):
            raise PatternError(f"{file}: is not allowed, a file below {folder} is (cloud_folder)")
        return str(path)

    def _shape(self, request: PatternRequest) -> Offsets:
        kind, spacing = request.kind, request.spacing
        if kind in self._tables or kind in FAMILIES:
            offsets = self._tables[kind] if kind in self._tables else FAMILIES[kind](self.count)
            return offsets if spacing is None else rescaled(offsets, spacing)
        if kind in SHAPES:
            return SHAPES[kind](self.count, PITCH if spacing is None else spacing)
        spacing = DENSE_PITCH if spacing is None else spacing
        if kind == "cloud":
            return cloud(self.count, spacing, request.argument)
        return text(self.count, spacing, request.argument, request.font)


def shipped_file() -> Path:
    """Return the file of XTDrone's patterns, from the source tree or the installed package."""
    source = Path(__file__).resolve().parents[3] / "config" / "patterns.yaml"
    if source.is_file():
        return source
    import rospkg  # needed by an installed package only

    return Path(rospkg.RosPack().get_path("xtdrone_coordination")) / "config" / "patterns.yaml"


@lru_cache(maxsize=16)
def _shipped_patterns(count: int) -> Mapping[str, Offsets]:
    return read_patterns(shipped_file(), count)


def read_patterns(file: Path, count: int) -> dict[str, Offsets]:
    """Return the patterns for ``count`` vehicles in a YAML file, empty if there are none.

    Raises:
        PatternError: the file cannot be read, or a pattern in it is not N-1 rows of three finite numbers at least
            0.5 m apart from each other and from the leader.
    """
    try:
        data = files.load_yaml(files.read_text(file))
    except OSError as error:
        raise PatternError(f"pattern file {file}: {error.strerror or error}") from error
    except files.ContentError as error:
        raise PatternError(f"pattern file {file} is not YAML: {error}") from error
    if not isinstance(data, Mapping):
        raise PatternError(f"pattern file {file}: must be {{number of vehicles: {{name: offsets}}}}")
    for key in data:
        if isinstance(key, bool) or not isinstance(key, int):
            raise PatternError(
                f"pattern file {file}: {key!r} is not a number of vehicles; "
                "must be {number of vehicles: {name: offsets}}"
            )
    section = data.get(count, {})
    if not isinstance(section, Mapping):
        raise PatternError(f"pattern file {file}: entry {count} must be {{name: offsets}}")
    return {str(name): check_offsets(rows, count, f"pattern {name!r} in {file}") for name, rows in section.items()}
