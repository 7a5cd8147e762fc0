"""Coverage paths: parallel lanes along which a camera sees all of a piece of ground.

The camera looks ahead of the vehicle, so a lane begins before the ground to be seen and ends before its far side. The
lanes are laid in the fastest direction, turns included, of those along the sides of the piece's convex hull; one of
these is across the piece's minimum width. A piece with holes or bays is flown either straight across them or cell by
cell, whichever is faster (H. Choset, "Coverage of known spaces: the boustrophedon cellular decomposition", Autonomous
Robots 9, 2000).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import Polygon

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.settings import Settings, check_range, setting

PERSON = 1.7  # m, height of a person
_MOST_DIRECTIONS = 12
_TURN = math.radians(30.0)  # a larger change of course is a turn

Point = tuple[float, float]


@dataclass(frozen=True)
class ImageFootprint:
    """Ground on which people are visible and large enough, relative to the point below the camera.

    Attributes:
        height: Height of the camera, m over the ground.
        near, far: distance ahead, m; near may be negative, behind the camera.
        half_near, half_far: half of the width there, m.
    """

    height: float
    near: float
    far: float
    half_near: float
    half_far: float

    def half_at(self, ahead: float) -> float:
        """Return half of the width ``ahead`` m ahead."""
        share = (ahead - self.near) / (self.far - self.near)
        return self.half_near + share * (self.half_far - self.half_near)

    def band(self, depth: float) -> tuple[float, float]:
        """Return the near edge of the farthest ``depth`` m, and half of the width there, the least of the band."""
        near = max(self.near, self.far - depth)
        return near, self.half_at(near)

    def outline(self, x: float, y: float, heading: float) -> NDArray[np.float64]:
        """Return the corners, (4, 2) m, for a camera over (x, y) with ``heading``, rad from east (ENU)."""
        corners = np.array(
            [
                (self.near, -self.half_near),
                (self.far, -self.half_far),
                (self.far, self.half_far),
                (self.near, self.half_near),
            ]
        )
        c, s = math.cos(heading), math.sin(heading)
        return np.array([x, y]) + corners @ np.array([[c, s], [-s, c]])


def footprint(
    camera: Pinhole, height: float, pitch: float, *, pixels: float = 12.0, margin: float = 0.05, reach: float = 30.0
) -> ImageFootprint:
    """Return the ground on which a camera shows standing people completely and large enough.

    Args:
        camera: its intrinsics.
        height: m over the ground, 2 to 200.
        pitch: Pitch of the gimbal, deg, negative down, -90 to -5.
        pixels: minimum height of a person in the image, from foot to head, px, 1 to 1000.
        margin: fraction of the image's width and height ignored at each edge, 0 to 0.4.
        reach: the ground counts up to this far ahead, m, 1 to 1000.

    Raises:
        ValueError: a value is out of range, or a person is nowhere large enough.
    """
    check_range("height", height, 2.0, 200.0, "m")
    check_range("gimbal_pitch", pitch, -90.0, -5.0, "deg")
    check_range("person_pixels", pixels, 1.0, 1000.0, "px")
    check_range("picture_margin", margin, 0.0, 0.4)
    check_range("reach", reach, 1.0, 1000.0, "m")
    down = math.radians(-pitch)
    ahead = np.arange(-height, reach + 0.005, 0.01)
    foot, depth = _row(camera, ahead, height, down)
    head, head_depth = _row(camera, ahead, height - PERSON, down)
    upper, lower = margin * camera.height, (1.0 - margin) * camera.height
    inside = (foot <= lower) & (head >= upper) & (depth > 0.0) & (head_depth > 0.0)
    found = np.flatnonzero(inside & (foot - head >= pixels))
    if not len(found):
        largest = float(np.max(np.where(inside, foot - head, 0.0)))
        raise ValueError(
            f"height: {height:g} m: with the gimbal at {pitch:g} deg a person of {PERSON} m within {reach:g} m is at "
            f"most {largest:.0f} px high, at least {pixels:g} px (person_pixels) are needed: fly lower or tilt the "
            "camera up"
        )
    gaps = np.flatnonzero(np.diff(found) > 1)
    first, last = found[gaps[-1] + 1 if len(gaps) else 0], found[-1]
    side = (0.5 - margin) * camera.width / camera.fx
    return ImageFootprint(
        height, float(ahead[first]), float(ahead[last]), float(side * depth[first]), float(side * depth[last])
    )


def _row(
    camera: Pinhole, ahead: NDArray[np.float64], below: float, down: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the image rows, px, and depths, m, of points ``ahead`` of and ``below`` the camera, m."""
    depth = ahead * math.cos(down) + below * math.sin(down)
    lower = below * math.cos(down) - ahead * math.sin(down)
    return camera.fy * lower / np.where(depth > 0.0, depth, np.nan) + camera.cy, depth


@dataclass(frozen=True)
class Waypoint:
    """Waypoint of a path.

    Attributes:
        x, y: m, map frame, ENU.
        heading: Heading of the vehicle on the leg to the waypoint, rad from east (ENU).
    """

    x: float
    y: float
    heading: float


@dataclass(frozen=True)
class CoverageOptions(Settings):
    """Spacing and cost of the lanes."""

    overlap: float = setting(
        0.2, low=0.0, high=0.8, text="fraction of the footprint's width seen from both neighbouring lanes"
    )
    depth: float = setting(
        10.0, low=1.0, high=100.0, unit="m", text="every place stays in view for this distance along the lane"
    )
    speed: float = setting(5.0, low=0.5, high=20.0, unit="m/s", text="speed over ground")
    turn_time: float = setting(3.0, low=0.0, high=60.0, unit="s", text="time lost in a turn")


def cover(piece: Polygon, seen: ImageFootprint, options: CoverageOptions, home: Point | None = None) -> list[Waypoint]:
    """Return the fastest path found along which the camera sees all of a piece.

    Args:
        piece: polygon, holes allowed, m ENU. The path may cross holes and the boundary.
        seen: the camera's footprint.
        options: see :class:`CoverageOptions`.
        home: start and end of the flight; None: the flight to and from the path is ignored.

    Returns:
        Two waypoints per lane, its start and its end, both with the heading of the lane.
    """
    paths = [path for angle in _angles(piece) for path in _paths(piece, angle, seen, options)]
    return min(paths, key=lambda path: _time(path, options, home))


def length(path: Sequence[Waypoint], home: Point | None = None) -> float:
    """Return the length of a path, m, including the legs from and to ``home`` if given."""
    places = [(w.x, w.y) for w in path]
    if home is not None:
        places = [home, *places, home]
    return sum(math.dist(a, b) for a, b in pairwise(places))


def turns(path: Sequence[Waypoint]) -> int:
    """Return the number of course changes of more than 30 degrees."""
    courses = [math.atan2(b.y - a.y, b.x - a.x) for a, b in pairwise(path) if math.dist((a.x, a.y), (b.x, b.y)) > 0.1]
    return sum(abs(math.remainder(b - a, 2.0 * math.pi)) > _TURN for a, b in pairwise(courses))


def sweep(path: Sequence[Waypoint], seen: ImageFootprint, step: float = 1.0) -> shapely.Geometry:
    """Return the ground shown by images taken every ``step`` m along a path."""
    outlines = []
    for a, b in pairwise(path):
        count = max(1, math.ceil(math.dist((a.x, a.y), (b.x, b.y)) / step))
        for i in range(count + 1):
            share = i / count
            outlines.append(seen.outline(a.x + share * (b.x - a.x), a.y + share * (b.y - a.y), b.heading))
    return shapely.union_all(shapely.polygons(outlines))


def lane_outlines(path: Sequence[Waypoint], seen: ImageFootprint) -> list[NDArray[np.float64]]:
    """Return the corners, (6, 2) m ENU, of the ground shown along each lane of a path as ``cover`` returns it."""
    outlines = []
    for a, b in zip(path[::2], path[1::2], strict=True):
        first, last = seen.outline(a.x, a.y, b.heading), seen.outline(b.x, b.y, b.heading)
        outlines.append(np.vstack([first[:2], last[1:3], first[2:]]))
    return outlines


def _time(path: Sequence[Waypoint], options: CoverageOptions, home: Point | None) -> float:
    return length(path, home) / options.speed + turns(path) * options.turn_time


def _angles(piece: Polygon) -> list[float]:
    """Return the lane directions to try, rad: along the sides of the hull, that across the minimum width first."""
    hull = shapely.get_coordinates(shapely.orient_polygons(piece.convex_hull))
    found: list[tuple[float, float]] = []
    for (x0, y0), (x1, y1) in pairwise(hull):
        side = math.hypot(x1 - x0, y1 - y0)
        if side == 0.0:
            continue
        angle = math.atan2(y1 - y0, x1 - x0) % math.pi
        width = float(np.ptp(hull @ np.array([-math.sin(angle), math.cos(angle)])))
        if all(abs(math.remainder(angle - other, math.pi)) > math.radians(1.0) for _, other in found):
            found.append((width, angle))
    return [angle for _, angle in sorted(found)[:_MOST_DIRECTIONS]]


@dataclass(frozen=True)
class _Strip:
    """Part of a piece seen from one lane: its centre line y, from x = low to high, in the frame of the lanes."""

    y: float
    low: float
    high: float


_Cell = list[_Strip]


def _paths(piece: Polygon, angle: float, seen: ImageFootprint, options: CoverageOptions) -> Iterator[list[Waypoint]]:
    """Yield the paths with lanes in direction ``angle``, rad."""
    c, s = math.cos(angle), math.sin(angle)
    turned = shapely.transform(piece, lambda xy: xy @ np.array([[c, -s], [s, c]]))
    rows = _rows(turned, seen, options)
    across = [_Strip(row[0].y, row[0].low, row[-1].high) for row in rows if row]
    layouts: list[list[_Cell]] = [[across]]
    if any(len(row) > 1 for row in rows):
        layouts.append(_cells(rows))
    near, _ = seen.band(options.depth)
    for cells in layouts:
        for first in range(len(cells)):
            for variant in range(4):
                lanes = _tour(cells, first, variant, near, seen.far)
                yield [
                    Waypoint(c * x - s * y, s * x + c * y, angle if b > a else angle + math.pi)
                    for a, b, y in lanes
                    for x in (a, b)
                ]


def _rows(piece: Polygon, seen: ImageFootprint, options: CoverageOptions) -> list[list[_Strip]]:
    """Return the strips each lane must cover: one, or several with wide gaps between them."""
    _, half = seen.band(options.depth)
    low_x, low_y, high_x, high_y = piece.bounds
    width = 2.0 * half * (1.0 - options.overlap)
    count = max(1, math.ceil((high_y - low_y) / width - 1e-9))
    reach = max(half, 0.5 * (high_y - low_y) / count)  # a lane covers more than its spacing
    spacing = (high_y - low_y) / count
    rows = []
    for i in range(count):
        y = low_y + (i + 0.5) * spacing
        box = shapely.box(low_x - 1.0, y - 0.5 * spacing, high_x + 1.0, y + 0.5 * spacing)
        spans = sorted(
            (part.bounds[0], part.bounds[2])
            for part in shapely.get_parts(piece.intersection(box))
            if isinstance(part, Polygon)
        )
        strips: list[_Strip] = []
        for low, high in spans:
            if strips and low - strips[-1].high < seen.far + reach:
                strips[-1] = _Strip(y, strips[-1].low, max(high, strips[-1].high))
            else:
                strips.append(_Strip(y, low, high))
        rows.append(strips)
    return rows


def _cells(rows: Sequence[Sequence[_Strip]]) -> list[_Cell]:
    """Return the cells: strips of consecutive lanes that lie side by side, until they split or merge."""
    cells: list[_Cell] = []
    open_cells: list[_Cell] = []
    for row in rows:
        beside = [[cell for cell in open_cells if _beside(cell[-1], strip)] for strip in row]
        going_on: list[_Cell] = []
        for strip, before in zip(row, beside, strict=True):
            if len(before) == 1 and sum(_beside(before[0][-1], other) for other in row) == 1:
                before[0].append(strip)
                going_on.append(before[0])
            else:
                cell = [strip]
                cells.append(cell)
                going_on.append(cell)
        open_cells = going_on
    return cells


def _beside(one: _Strip, other: _Strip) -> bool:
    return one.low < other.high and other.low < one.high


_Lane = tuple[float, float, float]  # x of its start and end, y


def _tour(cells: Sequence[_Cell], first: int, variant: int, near: float, far: float) -> list[_Lane]:
    """Return the lanes of all cells, visiting next the cell whose first lane starts nearest."""
    lanes = _lanes(cells[first], variant, near, far)
    left = [cell for i, cell in enumerate(cells) if i != first]
    while left:
        end = (lanes[-1][1], lanes[-1][2])
        options = [(_lanes(cell, v, near, far), i) for i, cell in enumerate(left) for v in range(4)]
        nearest, i = min(options, key=lambda option: math.dist(end, (option[0][0][0], option[0][0][2])))
        lanes += nearest
        left.pop(i)
    return lanes


def _lanes(cell: _Cell, variant: int, near: float, far: float) -> list[_Lane]:
    """Return the lanes of a cell, starting at one of its four corners, ``variant`` 0 to 3."""
    strips = cell if variant < 2 else cell[::-1]
    lanes = []
    for i, strip in enumerate(strips):
        if (i + variant) % 2 == 0:
            lanes.append((strip.low - far, strip.high - near, strip.y))
        else:
            lanes.append((strip.high + far, strip.low + near, strip.y))
    return lanes
