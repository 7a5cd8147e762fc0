"""Formation patterns: where each follower's slot lies relative to the leader.

A pattern for N vehicles is an array of shape (N-1, 3): metres, ENU, row k for slot k+1; the leader (vehicle 0) is at
the origin. XTDrone's own patterns for 6, 9 and 18 vehicles are data (``config/patterns.yaml``); ``origin``, ``cube``,
``pyramid`` and ``triangle`` are generated for every other number, so that any swarm can fly them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

Offsets = NDArray[np.float64]

MIN_SEPARATION = 0.5  # m between any two slots: closer vehicles touch
PITCH = 3.0  # m, of the spawn grid


class PatternError(ValueError):
    """A pattern that does not exist or cannot be flown."""


class Patterns:
    """The patterns of one swarm.

    Attributes:
        count: number of vehicles N, the leader included.
    """

    def __init__(self, count: int, file: str | Path | None = None) -> None:
        """Collect XTDrone's patterns for ``count`` vehicles, those of a user's file and the generated ones.

        Args:
            count: N, at least 2.
            file: YAML with more patterns, ``{N: {name: [[x, y, z], ...]}}``; a name in it replaces ours.

        Raises:
            PatternError: ``count`` is less than 2; the file is missing, malformed or holds a pattern of another size.
        """
        if count < 2:
            raise PatternError(f"number of vehicles: {count} is not allowed, a formation has at least 2")
        self.count = count
        self._tables = read_patterns(shipped_file(), count)
        if file is not None:
            self._tables.update(read_patterns(Path(file), count))
        for name, generate in _GENERATED.items():
            if name not in self._tables:
                self._tables[name] = generate(count)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the patterns, XTDrone's first, in the order of the keyboard's digits."""
        return tuple(self._tables)

    def offsets(self, name: str) -> Offsets:
        """Return a copy of the slots of pattern ``name``, shape (N-1, 3), m ENU from the leader.

        Raises:
            PatternError: there is no such pattern for this number of vehicles.
        """
        if name not in self._tables:
            raise PatternError(f"pattern {name!r} is unknown for {self.count} vehicles; there are: {self.describe()}")
        return self._tables[name].copy()

    def describe(self) -> str:
        """Return the names as one line of text."""
        return ", ".join(self._tables)

    def __contains__(self, name: str) -> bool:
        """Return whether there is a pattern of this name."""
        return name in self._tables


def shipped_file() -> Path:
    """Return the file of XTDrone's patterns, in the source tree or in the installed package."""
    source = Path(__file__).resolve().parents[2] / "config" / "patterns.yaml"
    if source.is_file():
        return source
    import rospkg  # only an installed package needs it

    return Path(rospkg.RosPack().get_path("xtdrone_coordination")) / "config" / "patterns.yaml"


def read_patterns(file: Path, count: int) -> dict[str, Offsets]:
    """Return the patterns for ``count`` vehicles in a YAML file, empty when it has none for that number.

    Raises:
        PatternError: the file cannot be read, or a pattern in it is not N-1 rows of three finite numbers at least
            0.5 m apart from each other and from the leader.
    """
    try:
        data = yaml.safe_load(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise PatternError(f"pattern file {file}: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise PatternError(f"pattern file {file} is not YAML: {error}") from error
    if not isinstance(data, Mapping):
        raise PatternError(f"pattern file {file}: must be {{number of vehicles: {{name: offsets}}}}")
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
    if separation < MIN_SEPARATION:
        raise PatternError(f"{name}: two vehicles are {separation:.2f} m apart, at least {MIN_SEPARATION} m is allowed")
    return offsets


def least_separation(offsets: Offsets) -> float:
    """Return the least distance in metres between any two vehicles of a pattern, the leader at the origin included."""
    points = with_leader(offsets)
    distances = np.linalg.norm(points[:, None] - points[None], axis=-1)
    return float(distances[np.triu_indices(len(points), 1)].min())


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
