"""Maze: corridors between walls on a grid of cells; with ``loops`` 0 exactly one route connects any two cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.settings import Settings, setting
from xtdrone_worlds.shapes.visual import Colour, Visual
from xtdrone_worlds.worlds.scenery.start_area_and_ground import BESIDE, START, box, ground, solid, world
from xtdrone_worlds.worlds.sdf import SdfWorld

_WALL: Colour = (0.82, 0.78, 0.7, 1.0)
_MARK: Colour = (0.75, 0.25, 0.2, 1.0)


@dataclass(frozen=True)
class MazeSettings(Settings):
    """Options of a maze."""

    seed: int = setting(0, low=0, text="seed of all random choices")
    columns: int = setting(8, low=1, high=60, text="cells along x")
    rows: int = setting(8, low=1, high=60, text="cells along y")
    cell: float = setting(3.0, low=1.0, high=30.0, unit="m", text="side of a cell, from wall to wall")
    height: float = setting(3.0, low=0.5, high=20.0, unit="m", text="height of the walls")
    wall: float = setting(0.15, low=0.02, high=1.0, unit="m", text="thickness of the walls")
    loops: float = setting(0.0, low=0.0, high=1.0, text="share of the inner walls left out in addition")


def passages(rng: np.random.Generator, columns: int, rows: int, loops: float) -> tuple[NDArray[np.bool_], ...]:
    """Return which neighbours are connected: towards +x (columns - 1, rows) and towards +y (columns, rows - 1).

    A depth-first search from the entrance's cell, (0, 0), reaches each cell once; then the share ``loops`` of the
    remaining walls is removed.
    """
    east, north = np.zeros((columns - 1, rows), bool), np.zeros((columns, rows - 1), bool)
    seen = np.zeros((columns, rows), bool)
    seen[0, 0] = True
    trail = [(0, 0)]
    while trail:
        i, j = trail[-1]
        around = [(i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)]
        fresh = [(a, b) for a, b in around if 0 <= a < columns and 0 <= b < rows and not seen[a, b]]
        if not fresh:
            trail.pop()
            continue
        a, b = fresh[int(rng.integers(len(fresh)))]
        if a != i:
            east[min(a, i), j] = True
        else:
            north[i, min(b, j)] = True
        seen[a, b] = True
        trail.append((a, b))
    for table in (east, north):
        table |= rng.uniform(size=table.shape) < loops
    return east, north


def maze(settings: MazeSettings) -> SdfWorld:
    """Generate the maze of a seed: entrance at its west side opposite the start area, exit at its east side."""
    rng = np.random.default_rng((settings.seed, 40))
    east, north = passages(rng, settings.columns, settings.rows, settings.loops)
    step = settings.cell + settings.wall
    y0 = 0.5 * (START[1] + START[3]) - 0.5 * step
    shapes = [
        _wall(settings, BESIDE, y0, *segment) for segment in _segments(east, north, settings.columns, settings.rows)
    ]
    end = (BESIDE + step * settings.columns, y0 + step * settings.rows)
    mark = box((0.4, settings.cell, 0.01), (end[0] + 0.5, end[1] - 0.5 * step, 0.005), _MARK)
    models = [ground("gravel", (BESIDE, y0, *end)), solid("walls", shapes), solid("exit", [], [mark])]
    return world(f"maze_{settings.seed}", models)


def _segments(
    east: NDArray[np.bool_], north: NDArray[np.bool_], columns: int, rows: int
) -> Iterator[tuple[bool, int, int, int]]:
    """Yield straight walls: whether along x, the grid line, and first and last (excluded) cell along the wall."""
    for line in range(rows + 1):
        closed = [line in (0, rows) or not north[i, line - 1] for i in range(columns)]
        yield from ((True, line, a, b) for a, b in _runs(closed))
    for line in range(columns + 1):
        closed = [line in (0, columns) or not east[line - 1, j] for j in range(rows)]
        if line == 0:
            closed[0] = False  # the entrance
        if line == columns:
            closed[-1] = False  # the exit
        yield from ((False, line, a, b) for a, b in _runs(closed))


def _runs(closed: list[bool]) -> Iterator[tuple[int, int]]:
    start = None
    for k, one in enumerate([*closed, False]):
        if one and start is None:
            start = k
        elif not one and start is not None:
            yield start, k
            start = None


def _wall(settings: MazeSettings, x0: float, y0: float, along_x: bool, line: int, first: int, last: int) -> Visual:
    step, thick, height = settings.cell + settings.wall, settings.wall, settings.height
    length, middle, across = (last - first) * step + thick, 0.5 * (first + last) * step, line * step
    if along_x:
        return box((length, thick, height), (x0 + middle, y0 + across, 0.5 * height), _WALL)
    return box((thick, length, height), (x0 + across, y0 + middle, 0.5 * height), _WALL)
