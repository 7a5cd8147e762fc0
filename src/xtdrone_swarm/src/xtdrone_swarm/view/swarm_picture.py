"""A Matplotlib picture of a swarm: vehicles, trails, topology, slots and shadows in a room with scales in metres."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.path import Path
from matplotlib.text import Text
from matplotlib.transforms import IdentityTransform
from numpy.typing import NDArray

from xtdrone_swarm.view.projection_and_zoom import Array, Box, Camera, FollowingBox, Projection
from xtdrone_swarm.view.walls_and_scales import Room

SIZE = (960, 720)  # pixels
TRAILS = 4.0  # s
LEAST_SIZE, GREATEST_SIZE = 200, 4096  # pixels, of a picture's edge
LEADER_COLOUR = "#15181c"
_DPI = 72.0  # so that a point is a pixel
_HEIGHT = 600.0  # pixels, height of the picture to which the sizes below refer
_MAX_NAMES = 18  # vehicles; larger swarms are drawn without names
_MAX_SHAPES = 40  # vehicles; larger swarms are drawn as dots
_MAX_DROPS = 36  # vehicles; larger swarms are drawn without lines to the floor
_SHADES = 24  # colours of a swarm
_SAMPLES = 48  # of a trail
_FOG = 0.4  # share of the background in the farthest vehicle's colour
_SLOT, _SHADOW, _LINK, _TITLE, _NOTE = "#64748b", "#1f2937", "#475569", "#1b2733", "#51606e"


@dataclass(frozen=True)
class Frame:
    """The displayed state at one time. All positions are ENU in the ``map`` frame, m; NaN where unknown.

    Attributes:
        time: simulated time, s.
        positions: positions of all vehicles, the leader first, shape (N, 3).
        slots: slots of all vehicles, the leader first, shape (N, 3); None without a formation.
        edges: pairs (i, j): i listens to j, shape (E, 2); None without a topology.
        title: title, for example the pattern's name.
        note: text to the right of the time, for example the real-time factor.
    """

    time: float
    positions: Array
    slots: Array | None = None
    edges: NDArray[np.int64] | None = None
    title: str = ""
    note: str = ""


def palette(count: int) -> Array:
    """Return one colour for each vehicle, RGB, shape (count, 3): the leader's, then those of the other plots.

    A large swarm has 24 colours, so that trails of one colour are drawn together.
    """
    if count <= 11:
        others = np.array(matplotlib.colormaps["tab10"].colors[: count - 1]).reshape(-1, 3)
    else:
        shade = np.arange(count - 1) * _SHADES // (count - 1) if count - 1 > _SHADES else np.arange(count - 1)
        others = matplotlib.colormaps["turbo"](0.05 + 0.9 * shade / shade.max())[:, :3]
    return np.vstack([to_rgb(LEADER_COLOUR), others])


class SwarmView:
    """The picture of a swarm: :meth:`update` stores a state cheaply, and drawing happens only on request.

    Attributes:
        figure: the Matplotlib figure; ``view.figure.savefig("swarm.pdf")`` works, too.
        camera: viewpoint.
        names: names of the vehicles.
        show_slots: whether the slots are drawn; may be changed at any time, like the next two.
        show_edges: whether the topology is drawn.
        trails: length of the trails, s of simulated time; 0: none.
        hint: text in the lower right corner.
        help: text in a box over the picture; "" for none.
    """

    def __init__(
        self,
        names: Sequence[str],
        *,
        slots: bool = True,
        edges: bool = True,
        trails: float = TRAILS,
        size: tuple[int, int] = SIZE,
    ) -> None:
        """Prepare the picture.

        Args:
            names: names of the vehicles, the leader's first; at least one.
            slots: whether the slots are drawn.
            edges: whether the topology is drawn.
            trails: length of the trails, s of simulated time; 0: none.
            size: width and height, pixels.

        Raises:
            ValueError: ``names`` is empty, ``trails`` is negative or not finite, or ``size`` is out of range.
        """
        if not len(names):
            raise ValueError("view: no vehicle to show")
        if not 0.0 <= trails < np.inf:
            raise ValueError(f"view: trails of {trails} s are not allowed, 0 or more")
        if any(not LEAST_SIZE <= edge <= GREATEST_SIZE for edge in size):
            raise ValueError(f"view: size {size} is not allowed, {LEAST_SIZE} to {GREATEST_SIZE} pixels each")
        self.names = tuple(names)
        self.show_slots, self.show_edges, self.trails = slots, edges, float(trails)
        self.hint = self.help = ""
        self.camera = Camera()
        self.figure = Figure(figsize=(size[0] / _DPI, size[1] / _DPI), dpi=_DPI, facecolor="white")
        self.canvas = FigureCanvasAgg(self.figure)
        self.colours = palette(len(names))
        self._box = FollowingBox()
        self._frame: Frame | None = None
        self._past: deque[tuple[float, Array]] = deque()
        self._sampled = -np.inf
        self._shown_box = self._box.follow(0.0, np.zeros((0, 3)))
        self._box.forget()
        self._scene = _Scene(self)
        self.figure.add_artist(self._scene)

    # ---- states ----

    def update(self, frame: Frame) -> None:
        """Store a state; the next picture shows the last one stored.

        When time runs backwards, trails and picture are reset.


        Raises:
            ValueError: an array has a wrong shape, or an edge refers to a vehicle that does not exist.
        """
        frame = _check(frame, len(self.names))
        if self._frame is not None and frame.time < self._frame.time:
            self._past.clear()
            self._sampled = -np.inf
            self._box.forget()
        if frame.time - self._sampled >= self.trails / _SAMPLES:
            self._past.append((frame.time, frame.positions))
            self._sampled = frame.time
        while self._past and self._past[0][0] < frame.time - self.trails:
            self._past.popleft()
        self._frame = frame
        shown = [frame.positions] if frame.slots is None or not self.show_slots else [frame.positions, frame.slots]
        self._shown_box = self._box.follow(frame.time, np.concatenate(shown))

    @property
    def frame(self) -> Frame | None:
        """Return the last state stored; None before the first."""
        return self._frame

    # ---- pictures ----

    def draw(self) -> NDArray[np.uint8]:
        """Draw the last state and return the picture, RGBA, shape (height, width, 4), valid until the next call."""
        renderer = self.canvas.get_renderer()
        self._scene.draw_fast(self.canvas, renderer)
        return np.asarray(renderer.buffer_rgba())

    def refresh(self, canvas: Any) -> None:
        """Draw the last state on another Agg canvas, such as a window's, to which the figure is attached."""
        self._scene.draw_fast(canvas, canvas.get_renderer())

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height of the picture, pixels."""
        return round(self.figure.bbox.width), round(self.figure.bbox.height)

    @property
    def projection(self) -> Projection:
        """Return the current projection to pixels (y upwards)."""
        width, height = self.figure.bbox.width, self.figure.bbox.height
        pixel = self.pixel
        margins = (58.0 * pixel, 50.0 * pixel, 30.0 * pixel, 52.0 * pixel)  # left, bottom, right, top
        area = (margins[0], margins[1], width - margins[0] - margins[2], height - margins[1] - margins[3])
        return self.camera.look(self._shown_box, area)

    @property
    def pixel(self) -> float:
        """Return the scale of the picture: 1 at a height of 600 pixels."""
        return min(self.figure.bbox.height / _HEIGHT, self.figure.bbox.width / _HEIGHT)

    def trail_points(self) -> tuple[Array, Array]:
        """Return the ages of the trails' points, s, shape (k,), oldest first, and the points, shape (k, N, 3)."""
        assert self._frame is not None
        known = [(t, p) for t, p in self._past if t < self._frame.time]
        known.append((self._frame.time, self._frame.positions))
        return self._frame.time - np.array([t for t, _ in known]), np.stack([p for _, p in known])

    @property
    def box(self) -> Box:
        """Return the displayed box."""
        return self._shown_box


def _check(frame: Frame, count: int) -> Frame:
    """Return a frame with copied arrays of validated shapes."""
    if not np.isfinite(frame.time):
        raise ValueError(f"view: time {frame.time} s is not allowed, it must be finite")
    positions = np.array(frame.positions, dtype=np.float64)
    if positions.shape != (count, 3):
        raise ValueError(f"view: positions have shape {positions.shape}, {count} vehicles need ({count}, 3)")
    slots = None if frame.slots is None else np.array(frame.slots, dtype=np.float64)
    if slots is not None and slots.shape != (count, 3):
        raise ValueError(f"view: slots have shape {slots.shape}, {count} vehicles need ({count}, 3)")
    edges = None if frame.edges is None else np.array(frame.edges, dtype=np.int64).reshape(-1, 2)
    if edges is not None and edges.size and (edges.min() < 0 or edges.max() >= count):
        raise ValueError(f"view: edges name vehicles {edges.min()} to {edges.max()}, there are 0 to {count - 1}")
    return Frame(float(frame.time), positions, slots, edges, frame.title, frame.note)


class _Scene(Artist):
    """The whole picture as one artist; static parts are drawn once and cached."""

    def __init__(self, view: SwarmView) -> None:
        """Create the artists of ``view``."""
        super().__init__()
        self._view = view
        self._kept: tuple[Any, Any] | None = None  # the room's picture, and the values that it depends on
        figure = view.figure
        pixels: dict[str, Any] = {"transform": IdentityTransform(), "figure": figure}
        marks: dict[str, Any] = {"offset_transform": IdentityTransform(), "snap": False, **pixels}
        self._room = Room(figure)
        self._shadows = PathCollection([Path.unit_circle()], facecolors=_SHADOW, edgecolors="none", **marks)
        self._drops = PathCollection([], facecolors="none", edgecolors=_LINK, alpha=0.28, linestyles=":", **pixels)
        self._links = PathCollection([], facecolors="none", edgecolors=_LINK, **pixels)
        self._trails = PathCollection([], facecolors="none", capstyle="butt", joinstyle="round", **pixels)
        self._slots = PathCollection([Path.unit_circle()], facecolors="none", **marks)
        self._rotors = PathCollection([_ROTORS], edgecolors="white", **marks)
        self._vehicles = PathCollection([Path.unit_circle()], edgecolors="white", **marks)
        star: dict[str, Any] = {"facecolors": LEADER_COLOUR, "edgecolors": "white"}
        self._leader = PathCollection([Path.unit_regular_star(5, 0.45)], **star, **marks)
        text: dict[str, Any] = {"figure": figure, "transform": IdentityTransform()}
        self._title = Text(0, 0, "", color=_TITLE, weight="bold", va="center", ha="left", **text)
        self._note = Text(0, 0, "", color=_NOTE, va="center", ha="right", **text)
        named = view.names if len(view.names) <= _MAX_NAMES else ()
        self._hint = Text(0, 0, "", color=_NOTE, va="center", ha="right", **text)
        box = {"boxstyle": "round,pad=0.8", "facecolor": "white", "edgecolor": _SLOT, "alpha": 0.93}
        self._help = Text(
            0, 0, "", color=_TITLE, va="bottom", ha="right", family="monospace", ma="left", bbox=box, **text
        )
        self._names = [Text(0, 0, name, va="bottom", ha="left", color=_NOTE, **text) for name in named]
        self._key_line = LineCollection([], colors=_LINK, **pixels)
        self._key_texts = [Text(0, 0, "", color=_NOTE, va="center", ha="left", **text) for _ in range(4)]

    # ---- drawing ----

    def draw(self, renderer: RendererBase) -> None:
        """Draw everything; called by Matplotlib."""
        projection = self._view.projection
        self._place_room(projection)
        self._draw_still(renderer)
        self._draw_moving(renderer, projection)

    def draw_fast(self, canvas: Any, renderer: Any) -> None:
        """Draw everything on an Agg canvas, with static parts from the cache."""
        projection = self._view.projection
        box, camera, figure = self._view.box, self._view.camera, self._view.figure
        state = (*box.low, *box.high, camera.azimuth, camera.elevation, camera.zoom, *figure.bbox.size, id(canvas))
        state += (self._view.show_slots, self._view.show_edges)
        if self._kept is not None and self._kept[0] == state:
            canvas.restore_region(self._kept[1])
        else:
            renderer.clear()
            self._place_room(projection)
            figure.patch.draw(renderer)
            self._draw_still(renderer)
            self._kept = (state, canvas.copy_from_bbox(figure.bbox))
        self._draw_moving(renderer, projection)

    def _place_room(self, projection: Projection) -> None:
        self._room.place(self._view.box, projection, self._points)

    @property
    def _points(self) -> float:
        """Size in points of one pixel of a picture 600 pixels high."""
        return self._view.pixel * 72.0 / self._view.figure.dpi

    def _draw_still(self, renderer: RendererBase) -> None:
        self._room.draw(renderer)
        self._draw_key(renderer)

    def _draw_moving(self, renderer: RendererBase, projection: Projection) -> None:
        frame = self._view.frame
        self._draw_title(renderer, frame)
        if frame is not None:
            self._draw_swarm(renderer, projection, frame)
        self._draw_help(renderer)

    def _draw_swarm(self, renderer: RendererBase, projection: Projection, frame: Frame) -> None:
        place, near = projection.pixels_and_nearness(frame.positions)
        known = np.flatnonzero(np.isfinite(place).all(axis=1))
        known = known[np.argsort(near[known], kind="stable")]  # the nearest last
        self._draw_shadows(renderer, projection, frame.positions[known])
        if self._view.show_edges and frame.edges is not None and len(frame.edges):
            self._draw_links(renderer, place, frame.edges)
        if self._view.trails > 0.0:
            self._draw_trails(renderer, projection)
        if self._view.show_slots and frame.slots is not None:
            self._draw_slots(renderer, projection, frame.slots)
        self._draw_vehicles(renderer, projection, place, near, known)
        self._draw_names(renderer, place, near)

    # ---- the parts ----

    @property
    def radius(self) -> float:
        """Radius of a vehicle at the centre of the box, in pixels of a picture 600 pixels high."""
        return float(np.clip(7.5 * (9.0 / len(self._view.names)) ** 0.22, 2.2, 8.0))

    def _flat(self, projection: Projection, shape: Path) -> Path:
        """Return the projection of a shape that lies horizontally in space (x east, y north)."""
        level = projection.basis[:2, :2].T
        return Path(shape.vertices @ level, shape.codes)

    def _draw_shadows(self, renderer: RendererBase, projection: Projection, positions: Array) -> None:
        if not len(positions):
            return
        count = len(self._view.names)
        floor = positions.copy()
        floor[:, 2] = self._view.box.low[2]
        place, near = projection.pixels_and_nearness(floor)
        if count <= _MAX_DROPS:
            self._drops.set_paths([_lines(np.stack([place, projection.pixels(positions)], axis=1))])
            self._drops.set_linewidth(0.9 * self._points)
            self._drops.draw(renderer)
        self._shadows.set_paths([self._flat(projection, Path.unit_circle())])
        self._shadows.set_offsets(place)
        self._shadows.set_sizes((self.radius * 0.9 * self._points * near) ** 2)
        self._shadows.set_alpha(0.16 if count <= 200 else 0.08)
        self._shadows.draw(renderer)

    def _draw_links(self, renderer: RendererBase, place: Array, edges: NDArray[np.int64]) -> None:
        crowd = (9.0 / len(self._view.names)) ** 0.3
        self._links.set_paths([_lines(place[edges])])
        self._links.set_linewidth(max(0.45, 1.5 * crowd) * self._points)
        self._links.set_alpha(float(np.clip(0.62 * crowd, 0.12, 0.6)))
        self._links.draw(renderer)

    def _draw_trails(self, renderer: RendererBase, projection: Projection) -> None:
        ages, points = self._view.trail_points()
        if len(ages) < 2:
            return
        count = len(self._view.names)
        pieces = 12 if count <= 40 else 7 if count <= 200 else 4
        if count > 200:  # every other sample, counted from the oldest so that the trail does not jump
            keep = np.r_[np.arange(0, len(ages) - 1, 2), len(ages) - 1]
            ages, points = ages[keep], points[keep]
        place = projection.pixels(points)
        piece = np.clip((pieces * (1.0 - ages / self._view.trails)).astype(int), 0, pieces - 1)
        paths, colours, widths = [], [], []
        groups = _groups(self._view.colours)
        width = max(0.7, 2.4 * (9.0 / count) ** 0.2) * self._points
        for number in range(pieces):
            inside = np.flatnonzero(piece[1:] == number)
            if not len(inside):
                continue
            freshness = (number + 1) / pieces
            part = place[inside[0] : inside[-1] + 2].transpose(1, 0, 2)
            for first, last in groups:
                paths.append(_lines(part[first:last]))
                colours.append((*self._view.colours[first], 0.7 * freshness**1.4 * (0.6 if count > 200 else 1.0)))
                widths.append(width * (0.45 + 0.55 * freshness))
        self._trails.set_paths(paths)
        self._trails.set_edgecolor(colours)
        self._trails.set_linewidth(widths)
        self._trails.draw(renderer)

    def _draw_slots(self, renderer: RendererBase, projection: Projection, slots: Array) -> None:
        place, near = projection.pixels_and_nearness(slots)
        known = np.flatnonzero(np.isfinite(place).all(axis=1))
        known = known[known > 0]  # without the leader, whose slot is its position
        if not len(known):
            return
        self._slots.set_offsets(place[known])
        self._slots.set_sizes((self.radius * 1.75 * self._points * near[known]) ** 2)
        self._slots.set_edgecolor(np.column_stack([self._view.colours[known], np.full(len(known), 0.8)]))
        self._slots.set_linewidth(max(0.5, 1.3 * (9.0 / len(self._view.names)) ** 0.2) * self._points)
        self._slots.draw(renderer)

    def _draw_vehicles(
        self, renderer: RendererBase, projection: Projection, place: Array, near: Array, known: NDArray[np.intp]
    ) -> None:
        """Draw the vehicles from the farthest to the nearest; the leader, a star, is never hidden."""
        radius = self.radius * self._points
        followers = known[known > 0]
        if len(followers):
            colours = _fog(self._view.colours[followers], near[followers], projection)
            if len(self._view.names) <= _MAX_SHAPES:
                self._rotors.set_paths([self._flat(projection, _ROTORS)])
                self._rotors.set_offsets(place[followers])
                self._rotors.set_sizes((2.1 * radius * near[followers]) ** 2)
                self._rotors.set_facecolor(colours)
                self._rotors.set_linewidth(0.09 * radius)
                self._rotors.draw(renderer)
            self._vehicles.set_offsets(place[followers])
            body = 0.85 if len(self._view.names) <= _MAX_SHAPES else 1.0
            self._vehicles.set_sizes((body * radius * near[followers]) ** 2)
            self._vehicles.set_facecolor(colours)
            self._vehicles.set_linewidth(max(0.35, 0.14 * radius))
            self._vehicles.draw(renderer)
        if len(followers) < len(known):
            self._leader.set_offsets(place[:1])
            self._leader.set_sizes([(2.1 * max(radius, 4.5 * self._points) * near[0]) ** 2])
            self._leader.set_linewidth(1.2 * self._points)
            self._leader.draw(renderer)

    def _draw_names(self, renderer: RendererBase, place: Array, near: Array) -> None:
        away = 1.1 * self.radius * self._view.pixel
        for name, spot, factor in zip(self._names, place, near, strict=False):
            if np.isfinite(spot).all():
                name.set_position((float(spot[0] + away * factor), float(spot[1] + away * factor)))
                name.set_fontsize(9.0 * self._points)
                name.draw(renderer)

    def _draw_title(self, renderer: RendererBase, frame: Frame | None) -> None:
        """Write the number of vehicles and the pattern on the left, time and note on the right."""
        width, height, pixel = self._view.figure.bbox.width, self._view.figure.bbox.height, self._view.pixel
        count = len(self._view.names)
        title = f"{count} UAV" + ("s" if count > 1 else "")
        self._title.set_text(f"{title}   {frame.title}" if frame is not None and frame.title else title)
        self._title.set_position((22.0 * pixel, height - 24.0 * pixel))
        self._title.set_fontsize(15.0 * self._points)
        self._title.draw(renderer)
        if frame is not None:
            self._note.set_text(f"t = {frame.time:.1f} s" + (f"   {frame.note}" if frame.note else ""))
            self._note.set_position((width - 22.0 * pixel, height - 24.0 * pixel))
            self._note.set_fontsize(12.0 * self._points)
            self._note.draw(renderer)

    def _draw_help(self, renderer: RendererBase) -> None:
        """Write the hint and the help text, if set."""
        width, pixel = self._view.figure.bbox.width, self._view.pixel
        for artist, text, height in ((self._hint, self._view.hint, 18.0), (self._help, self._view.help, 48.0)):
            if text:
                artist.set_text(text)
                artist.set_position((width - 22.0 * pixel, height * pixel))
                artist.set_fontsize(10.0 * self._points)
                artist.draw(renderer)

    def _draw_key(self, renderer: RendererBase) -> None:
        """Draw the legend of the markers in a line below the room."""
        pixel, points = self._view.pixel, self._points
        colour = self._view.colours[min(1, len(self._view.names) - 1)]
        entries: list[tuple[str, PathCollection | None]] = [("leader", self._leader), ("follower", self._vehicles)]
        if self._view.show_slots:
            entries.append(("slot", self._slots))
        if self._view.show_edges:
            entries.append(("listens to", None))
        x, y = 30.0 * pixel, 18.0 * pixel
        for (word, mark), text in zip(entries, self._key_texts, strict=False):
            if mark is None:
                self._key_line.set_segments([np.array([[x - 10.0 * pixel, y], [x + 8.0 * pixel, y]])])
                self._key_line.set_linewidth(1.3 * points)
                self._key_line.draw(renderer)
            else:
                mark.set_offsets([[x, y]])
                mark.set_sizes([((9.0 if mark is self._leader else 5.5) * points) ** 2])
                mark.set_linewidth((1.3 if mark is self._slots else 0.6) * points)
                if mark is not self._leader:
                    (mark.set_edgecolor if mark is self._slots else mark.set_facecolor)([colour])
                mark.draw(renderer)
                if mark is self._vehicles:
                    mark.set_edgecolor("white")
            text.set_text(word)
            text.set_position((x + 14.0 * pixel, y - 0.5 * pixel))
            text.set_fontsize(10.0 * points)
            text.draw(renderer)
            x += (40.0 + 6.0 * len(word)) * pixel


def _lines(points: Array) -> Path:
    """Return polylines as one path, from points of shape (lines, points per line, 2)."""
    lines, length, _ = points.shape
    codes = np.full((lines, length), Path.LINETO, dtype=Path.code_type)
    codes[:, 0] = Path.MOVETO
    return Path(points.reshape(-1, 2), codes.ravel())


def _groups(colours: Array) -> list[tuple[int, int]]:
    """Return the half-open index range of each run of vehicles with the same colour."""
    cuts = np.flatnonzero(np.any(colours[1:] != colours[:-1], axis=1)) + 1
    bounds = [0, *cuts.tolist(), len(colours)]
    return list(pairwise(bounds))


def _fog(colours: Array, near: Array, projection: Projection) -> Array:
    """Return colours faded towards white with the distance."""
    low, high = projection.nearness_range
    fog = _FOG * np.clip((high - near) / (high - low), 0.0, 1.0) ** 2
    return colours + (1.0 - colours) * fog[:, None]


def _rotors() -> Path:
    """Return the top view of a quadrotor without its body: four rotors on arms, with the rotor centres at radius 1."""
    parts = []
    for angle in np.radians([45.0, 135.0, 225.0, 315.0]):
        along = np.array([np.cos(angle), np.sin(angle)])
        across = 0.1 * np.array([-along[1], along[0]])
        parts.append(
            Path(np.array([-across, 0.55 * along - across, 0.55 * along + across, across, -across]), closed=True)
        )
        parts.append(Path.circle(tuple(along), 0.52))
    return Path.make_compound_path(*parts)


_ROTORS = _rotors()
