"""The room around a swarm: floor and back walls with a grid, and scales in metres along the edges."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.backend_bases import RendererBase
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import IdentityTransform

from xtdrone_swarm.view.projection_and_zoom import Array, Box, Projection

_LINES = 7  # approximate number of grid lines along the longest edge
_GROUND, _FLOOR, _WALL = "#eaf0ea", "#f3f5f8", "#fafbfc"
_GRID, _EDGE, _TEXT = "#d3dae1", "#aab4bf", "#51606e"
_LETTERS = "xyz"


class Room:
    """Floor, walls, grid and scale labels, as artists in pixels."""

    def __init__(self, figure: Figure) -> None:
        """Create the artists on ``figure``."""
        self._figure = figure
        pixels = {"transform": IdentityTransform(), "figure": figure}
        self._panes = PolyCollection([], edgecolors="none", **pixels)
        self._grid = LineCollection([], colors=_GRID, **pixels)
        self._edges = LineCollection([], colors=_EDGE, **pixels)
        self._texts: list[Text] = []
        self._used = 0

    def place(self, box: Box, projection: Projection, unit: float) -> None:
        """Compute the positions of all artists.

        Args:
            box: the displayed box.
            projection: projection to pixels.
            unit: size in points of one pixel of a picture 600 pixels high.
        """
        eye = projection.basis[2]
        near = np.where(eye >= 0.0, box.high, box.low)
        far = np.where(eye >= 0.0, box.low, box.high)
        floor = box.low[2]
        step = grid_step(box)
        planes = [_plane(box, 2, floor), _plane(box, 0, far[0]), _plane(box, 1, far[1])]
        self._panes.set_verts([projection.pixels(p) for p in planes])
        self._panes.set_facecolor([_GROUND if floor == 0.0 else _FLOOR, _WALL, _WALL])
        lines = list(_grid_lines(box, step, (far[0], far[1], floor)))
        self._grid.set_segments([projection.pixels(np.array(line)) for line in lines])
        self._grid.set_linewidth(0.8 * unit)
        # The labelled edges are nearer than the swarm and on the outline, so that no object lies behind them.
        side = self._side(box, projection, near, far)
        ends = [
            np.array([[box.low[0], near[1], floor], [box.high[0], near[1], floor]]),
            np.array([[near[0], box.low[1], floor], [near[0], box.high[1], floor]]),
            np.array([[*side, floor], [*side, box.high[2]]]),
        ]
        self._edges.set_segments([projection.pixels(e) for e in ends])
        self._edges.set_linewidth(1.1 * unit)
        self._used = 0
        middle = projection.pixels(box.middle)
        for axis, edge in enumerate(ends):
            self._label(axis, edge, projection, middle, step, unit)

    @staticmethod
    def _side(box: Box, projection: Projection, near: Array, far: Array) -> tuple[float, float]:
        """Return x and y of the upright edge on the left of the picture."""
        sides = [(near[0], far[1]), (far[0], near[1])]
        columns = [projection.pixels(np.array([x, y, box.low[2]]))[0] for x, y in sides]
        return sides[int(np.argmin(columns))]

    def _label(self, axis: int, edge: Array, projection: Projection, middle: Array, step: float, unit: float) -> None:
        """Label an edge with numbers, axis letter and unit, on the side away from the room's centre."""
        start, end = projection.pixels(edge)
        along = end - start
        length = float(np.hypot(*along))
        if length < 40.0:
            return  # the edge is seen end-on
        outward = np.array([-along[1], along[0]]) / length
        if outward @ (0.5 * (start + end) - middle) < 0.0:
            outward = -outward
        pixel = unit * self._figure.dpi / 72.0
        ticks = _ticks(edge[0, axis], edge[1, axis], step)
        places = np.repeat(edge[:1], len(ticks), axis=0)
        places[:, axis] = ticks
        crowded = math.ceil(30.0 * pixel * max(1, len(ticks)) / length)
        for tick, place in list(zip(ticks, projection.pixels(places), strict=True))[::crowded]:
            self._write(f"{tick:g}", place + 13.0 * pixel * outward, 9.0 * unit, _TEXT)
        self._write(
            f"{_LETTERS[axis]} [m]",
            0.5 * (start + end) + (32.0 + 12.0 * abs(outward[0])) * pixel * outward,
            10.0 * unit,
            _TEXT,
        )

    def _write(self, text: str, place: Array, size: float, colour: str) -> None:
        """Place a text, with an existing artist if one is available."""
        if self._used == len(self._texts):
            centred = {"ha": "center", "va": "center", "transform": IdentityTransform()}
            self._texts.append(Text(0, 0, "", color=colour, figure=self._figure, **centred))
        artist = self._texts[self._used]
        self._used += 1
        artist.set_text(text)
        artist.set_position((float(place[0]), float(place[1])))
        artist.set_fontsize(size)

    def draw(self, renderer: RendererBase) -> None:
        """Draw the room as placed by :meth:`place`."""
        self._panes.draw(renderer)
        self._grid.draw(renderer)
        self._edges.draw(renderer)
        for text in self._texts[: self._used]:
            text.draw(renderer)


def grid_step(box: Box) -> float:
    """Return the spacing of the grid lines, m: 1, 2 or 5 times a power of ten."""
    rough = float((box.high - box.low).max()) / _LINES
    power = 10.0 ** math.floor(math.log10(rough))
    return power * min((1.0, 2.0, 5.0, 10.0), key=lambda f: abs(math.log(f * power / rough)))


def _ticks(low: float, high: float, step: float) -> Array:
    """Return the multiples of ``step`` from ``low`` to ``high``."""
    return step * np.arange(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)


def _plane(box: Box, axis: int, value: float) -> Array:
    """Return the corners of the box's cross-section at a value of an axis, in order around it, shape (4, 3)."""
    a, b = (k for k in range(3) if k != axis)
    corners = np.full((4, 3), value)
    corners[:, a] = [box.low[a], box.high[a], box.high[a], box.low[a]]
    corners[:, b] = [box.low[b], box.low[b], box.high[b], box.high[b]]
    return corners


def _grid_lines(box: Box, step: float, planes: tuple[float, float, float]) -> Iterator[Array]:
    """Yield the end points, shape (2, 3), of the grid lines and outlines of one plane across each axis."""
    for axis, value in enumerate(planes):
        a, b = (k for k in range(3) if k != axis)
        for across, along in ((a, b), (b, a)):
            for tick in {*_ticks(box.low[across], box.high[across], step), box.low[across], box.high[across]}:
                ends = np.full((2, 3), value)
                ends[:, across] = tick
                ends[:, along] = box.low[along], box.high[along]
                yield ends
