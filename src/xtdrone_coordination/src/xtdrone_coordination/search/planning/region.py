"""Division of a region, a polygon with or without holes, into connected pieces of equal area.

The region is bisected recursively by the shortest straight cut that leaves a whole number of pieces on both sides. If
every straight cut through the whole region leaves a disconnected side, a single part is cut off. If that fails too
(combs, spirals, thin rings), a band around a spanning tree of the region's triangles is cut into arcs: these pieces are
long and winding, but connected and of equal area.

Areas are equal up to rounding. The result is deterministic.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.optimize import brentq
from shapely.geometry import Polygon
from shapely.validation import explain_validity

from xtdrone_common import files

MAX_PIECES = 250
_DIRECTIONS = 16  # of cuts, in addition to the sides of the smallest rectangle
_BALANCES = 4  # ratios of pieces tried with straight cuts: the most balanced ones
_LEVELS = 60  # positions along a direction at which parts are searched for
_CRUMB = 1e-9  # fraction of a piece's area; smaller polygons are rounding errors
_UNEQUAL = 1e-6  # tolerance of a cut, as a fraction of a piece's area


class RegionError(ValueError):
    """An invalid region, or one that cannot be divided into the requested number of pieces."""


def make_region(corners: Sequence[Sequence[float]], holes: Sequence[Sequence[Sequence[float]]] = ()) -> Polygon:
    """Return the polygon of a region.

    Args:
        corners: (x, y) each, at least 3, in either order; map frame, ENU, m. The polygon is closed automatically.
        holes: corners of the areas inside to be left out.

    Raises:
        RegionError: too few or non-finite corners, a self-intersecting boundary, a hole outside, overlapping holes, or
            no area.
    """
    shell = _ring("region", corners)
    rings = [_ring(f"holes[{i}]", hole) for i, hole in enumerate(holes)]
    for name, ring in [("region", shell), *((f"holes[{i}]", ring) for i, ring in enumerate(rings))]:
        polygon = Polygon(ring)
        if not polygon.is_valid:
            raise RegionError(
                f"{name}: {explain_validity(polygon)}; a boundary that does not cross or touch itself is allowed"
            )
        if not polygon.area > 1e-12 * polygon.length**2:
            raise RegionError(f"{name}: an area of {polygon.area:g} m^2 is not allowed, more than 0")
    whole = Polygon(shell)
    for i, ring in enumerate(rings):
        if not whole.contains(Polygon(ring)):
            raise RegionError(f"holes[{i}]: it is not inside the region, as every hole must be")
    region = Polygon(shell, rings)
    if not region.is_valid:
        raise RegionError(f"holes: {explain_validity(region)}; holes that do not overlap or cut the region are allowed")
    return region


def parse_region(data: Any) -> Polygon:
    """Return the polygon that a mapping ``{region: [[x, y], ...], holes: [[[x, y], ...], ...]}`` describes.

    Raises:
        RegionError: the mapping is malformed, or see :func:`make_region`.
    """
    if not isinstance(data, Mapping) or "region" not in data:
        raise RegionError("region: a mapping with the key region, and holes if there are any, is needed")
    unknown = sorted(set(map(str, data)) - {"region", "holes"})
    if unknown:
        raise RegionError(f"region: unknown key {unknown[0]!r}; region and holes are allowed")
    return make_region(data["region"], data.get("holes") or ())


def read_region(path: str | Path) -> Polygon:
    """Return the polygon in a YAML file, see :func:`parse_region`.

    Raises:
        RegionError: the file cannot be read or holds no valid region; the message names the file.
    """
    try:
        return parse_region(files.load_yaml(files.read_text(path)))
    except (OSError, files.ContentError, RegionError) as error:
        raise RegionError(f"{path}: {error}") from error


def region_data(region: Polygon) -> dict[str, Any]:
    """Return the mapping of a region, as :func:`parse_region` reads it."""
    rings = [[[float(x), float(y)] for x, y in ring.coords[:-1]] for ring in (region.exterior, *region.interiors)]
    return {"region": rings[0], "holes": rings[1:]}


def divide(region: Polygon, count: int) -> list[Polygon]:
    """Divide a region into ``count`` connected pieces of equal area.

    Args:
        region: see :func:`make_region`.
        count: 1 to 250.

    Raises:
        RegionError: ``count`` is out of range, or the region is invalid.
    """
    if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= MAX_PIECES:
        raise RegionError(f"pieces: {count!r} is not allowed, 1 to {MAX_PIECES}")
    if not isinstance(region, Polygon) or not region.is_valid or not region.area > 0.0:
        raise RegionError("region: it is not a polygon with a positive area, which is needed")
    # normalise position and scale, so that rounding is the same for every region
    low = np.array(region.bounds[:2])
    scale = math.sqrt(region.area)
    here = shapely.transform(shapely.orient_polygons(region), lambda xy: (xy - low) / scale)
    pieces = _split(here, count)
    return [_sound(shapely.transform(piece, lambda xy: xy * scale + low)) for piece in pieces]


def _sound(piece: Polygon) -> Polygon:
    """Return a valid piece, without the artefacts of nearly coincident corners."""
    if piece.is_valid:
        return piece
    return max(_parts(shapely.make_valid(piece), 0.0), key=lambda part: part.area)


def _ring(name: str, corners: Any) -> list[tuple[float, float]]:
    try:
        ring = [(float(x), float(y)) for x, y in corners]
    except (TypeError, ValueError):
        raise RegionError(f"{name}: a list of corners [x, y], numbers in m, is needed") from None
    if not all(math.isfinite(x) and math.isfinite(y) for x, y in ring):
        raise RegionError(f"{name}: a corner is not finite")
    if len(set(ring)) < 3:
        raise RegionError(f"{name}: {len(set(ring))} different corners are not allowed, at least 3")
    return ring


# straight cuts


def _split(polygon: Polygon, count: int) -> list[Polygon]:
    """Return pieces of equal area, by straight cuts as long as these leave connected sides."""
    if count == 1:
        return [polygon]
    area = polygon.area / count
    best: _Cut | None = None
    for part in sorted(range(1, count), key=lambda k: abs(2 * k - count))[:_BALANCES]:
        best = best or min(_straight_cuts(polygon, area, part), key=_length, default=None)
    best = best or next(_partial_cuts(polygon, area, count), None)
    if best is None:
        return _arcs(polygon, count)
    _, left, right, part = best
    return _split(left, part) + _split(right, count - part)


_Cut = tuple[float, Polygon, Polygon, int]  # length, both sides, number of pieces on the first side


def _length(cut: _Cut) -> float:
    return cut[0]


def _straight_cuts(polygon: Polygon, area: float, part: int) -> Iterator[_Cut]:
    """Yield the cuts with ``part`` times ``area`` on the first side and both sides connected."""
    for direction in _directions(polygon):
        place = _sweep(polygon, direction, part * area)
        if place is None:
            continue
        half = _half_plane(polygon, direction, place)
        cut = _cut(polygon, polygon.intersection(half), polygon.difference(half), area, part)
        if cut is not None:
            yield cut


def _partial_cuts(polygon: Polygon, area: float, count: int) -> Iterator[_Cut]:
    """Yield, for each direction, the shortest cut that takes a single part off one side of a line."""
    for direction in (sign * d for d in _directions(polygon)[:: _DIRECTIONS // 4] for sign in (1.0, -1.0)):
        levels = np.unique(shapely.get_coordinates(polygon) @ direction)
        levels = levels[:: 1 + len(levels) // _LEVELS]
        cuts: list[_Cut] = []
        for before, level in pairwise(levels):
            # just below a corner, where the parts that meet at it are still separate
            side = polygon.intersection(_half_plane(polygon, direction, level - 1e-6 * (level - before)))
            for body in _parts(side, area):
                start = body.intersection(_half_plane(polygon, direction, before)).area
                for part in range(max(1, math.ceil(start / area)), min(count - 1, int(body.area / area)) + 1):
                    place = _sweep(body, direction, part * area)
                    if place is None:
                        continue
                    piece = body.intersection(_half_plane(polygon, direction, place))
                    cut = _cut(polygon, piece, polygon.difference(piece), area, part)
                    if cut is not None:
                        cuts.append(cut)
        if cuts:
            yield min(cuts, key=_length)


def _cut(polygon: Polygon, one: Any, other: Any, area: float, part: int) -> _Cut | None:
    """Return the cut if both sides are connected and have the right areas, else None."""
    sides = [_parts(side, area) for side in (one, other)]
    if any(len(side) != 1 for side in sides):
        return None
    left, right = sides[0][0], sides[1][0]
    if not (left.is_valid and right.is_valid):
        return None
    if abs(left.area - part * area) > _UNEQUAL * area or abs(left.area + right.area - polygon.area) > _UNEQUAL * area:
        return None
    return left.length + right.length - polygon.length, left, right, part


def _parts(area: Any, piece: float) -> list[Polygon]:
    """Return the polygons in the result of a cut, without rounding artefacts."""
    parts = shapely.get_parts(area)
    return [part for part in parts if isinstance(part, Polygon) and part.area > _CRUMB * piece]


def _directions(polygon: Polygon) -> list[NDArray[np.float64]]:
    """Return the unit normals of the cuts to try."""
    box = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))
    along = math.atan2(*(box[1] - box[0])[::-1]) if len(box) > 1 else 0.0
    angles = [along + i * math.pi / _DIRECTIONS for i in range(_DIRECTIONS)]
    if abs(math.sin(2.0 * along)) > 1e-6:
        angles += [0.0, 0.5 * math.pi]
    return [np.array([math.cos(a), math.sin(a)]) for a in angles]


def _half_plane(polygon: Polygon, direction: NDArray[np.float64], place: float) -> Polygon:
    """Return the half-plane below ``place`` along ``direction``, large enough to contain the polygon."""
    low_x, low_y, high_x, high_y = polygon.bounds
    reach = 2.0 * (math.hypot(high_x - low_x, high_y - low_y) + math.hypot(low_x, low_y) + abs(place))
    across = np.array([-direction[1], direction[0]])
    edge = place * direction
    corners = [edge - reach * across, edge + reach * across]
    return Polygon([*corners, corners[1] - 2.0 * reach * direction, corners[0] - 2.0 * reach * direction])


def _sweep(polygon: Polygon, direction: NDArray[np.float64], area: float) -> float | None:
    """Return the position of the line normal to ``direction`` with ``area`` of the polygon behind it, None if outside.

    By Green's theorem this area is the integral of min(t, place) du along the boundary, with t along the direction and
    u across. Between two corners it is a quadratic function of the place.
    """
    starts, ends = _edges(polygon)
    across = np.array([-direction[1], direction[0]])
    t0, t1 = starts @ direction, ends @ direction
    du = (ends - starts) @ across
    low, high = np.minimum(t0, t1), np.maximum(t0, t1)
    span = np.maximum(high - low, 1e-300)

    def behind(places: NDArray[np.float64]) -> NDArray[np.float64]:
        s = np.clip(places[:, None], low, high)
        mean = 0.5 * (s + low) * (s - low) / span + s * (high - s) / span
        mean = np.where(high - low > 1e-12, mean, np.minimum(places[:, None], low))
        return np.asarray(np.where(places[:, None] <= low, places[:, None], mean) @ du)

    levels = np.unique(np.concatenate([t0, t1]))
    areas = behind(levels)
    i = int(np.searchsorted(areas, area))
    if not 0 < i < len(levels):
        return None

    def excess(place: float) -> float:
        return float(behind(np.array([place]))[0] - area)

    if excess(levels[i - 1]) >= 0.0:  # equal up to rounding
        return float(levels[i - 1])
    if excess(levels[i]) <= 0.0:
        return float(levels[i])
    return float(brentq(excess, levels[i - 1], levels[i], xtol=1e-15))


def _edges(polygon: Polygon) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the start and end points of all edges, with the polygon on their left."""
    rings = [shapely.get_coordinates(ring) for ring in (polygon.exterior, *polygon.interiors)]
    starts, ends = [], []
    for i, ring in enumerate(rings):
        if (shapely.is_ccw(shapely.linearrings(ring))) != (i == 0):
            ring = ring[::-1]
        starts.append(ring[:-1])
        ends.append(ring[1:])
    return np.concatenate(starts), np.concatenate(ends)


# band around a spanning tree of triangles

_Point = tuple[float, float]
_Wedge = tuple[_Point, _Point, _Point]  # hinge, start and end of the opposite side, which cuts move along


def _arcs(polygon: Polygon, count: int) -> list[Polygon]:
    """Return pieces of equal area as arcs of a band that runs once around a spanning tree of triangles.

    Every triangle is split at its centroid into one wedge per side, and the wedge of a side that the tree crosses into
    two. Consecutive wedges of the band share an edge, so every arc is connected.
    """
    wedges = _band(polygon)
    areas = np.array([_area(wedge) for wedge in wedges])
    ends = np.cumsum(areas)
    piece = ends[-1] / count
    pieces: list[Polygon] = []
    parts: list[_Wedge] = []
    bound = piece
    for wedge, area, end in zip(wedges, areas, ends, strict=True):
        rest, left, done = wedge, area, end - area
        while len(pieces) < count - 1 and end >= bound:
            share = min(max((bound - done) / left, 0.0), 1.0) if left > 0.0 else 0.0
            hinge, start, stop = rest
            place = (start[0] + share * (stop[0] - start[0]), start[1] + share * (stop[1] - start[1]))
            parts.append((hinge, start, place))
            pieces.append(_union(parts))
            parts, rest, left, done = [], (hinge, place, stop), left * (1.0 - share), bound
            bound = (len(pieces) + 1) * piece
        parts.append(rest)
    pieces.append(_union(parts))
    return pieces


def _area(wedge: _Wedge) -> float:
    (ax, ay), (bx, by), (cx, cy) = wedge
    return 0.5 * abs((bx - ax) * (cy - ay) - (cx - ax) * (by - ay))


def _union(wedges: Sequence[_Wedge]) -> Polygon:
    bodies = [Polygon(wedge) for wedge in wedges if _area(wedge) > 0.0]
    whole = shapely.union_all(bodies)
    parts = [part for part in shapely.get_parts(whole) if isinstance(part, Polygon)]
    return max(parts, key=lambda part: part.area)


def _band(polygon: Polygon) -> list[_Wedge]:
    """Return the wedges in the order around the tree.

    The band follows a triangle's sides and crosses those that the tree crosses in their first half; it comes back
    through the second half, which is the first half as seen from the other triangle.
    """
    triangles = [
        [(float(x), float(y)) for x, y in shapely.get_coordinates(body)[:3]]
        for body in shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    ]
    # all have the same orientation; take it from the largest, since degenerate triangles do not show it
    if not _turns_left(max(triangles, key=lambda t: _area((t[0], t[1], t[2])))):
        triangles = [t[::-1] for t in triangles]
    centres = [(sum(x for x, _ in t) / 3.0, sum(y for _, y in t) / 3.0) for t in triangles]
    sides = {(t[i], t[(i + 1) % 3]): k for k, t in enumerate(triangles) for i in range(3)}
    tree = _tree(triangles, sides)
    wedges: list[_Wedge] = []
    k, i = 0, 0
    while True:
        p, q = triangles[k][i], triangles[k][(i + 1) % 3]
        neighbour = sides.get((q, p))
        if neighbour is None or frozenset((k, neighbour)) not in tree:
            wedges.append((centres[k], p, q))
            i = (i + 1) % 3
        else:
            m = _middle(p, q)
            wedges += [(p, centres[k], m), (p, m, centres[neighbour])]
            k, i = neighbour, triangles[neighbour].index(p)
        if (k, i) == (0, 0):
            return wedges


def _turns_left(t: Sequence[_Point]) -> bool:
    return (t[1][0] - t[0][0]) * (t[2][1] - t[0][1]) > (t[2][0] - t[0][0]) * (t[1][1] - t[0][1])


def _middle(p: _Point, q: _Point) -> _Point:
    """Return the midpoint, bit-identical from both sides."""
    return (0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1]))


def _tree(triangles: Sequence[Sequence[_Point]], sides: Mapping[tuple[_Point, _Point], int]) -> set[frozenset[int]]:
    """Return the pairs of neighbours in a spanning tree; breadth first keeps its branches short."""
    tree: set[frozenset[int]] = set()
    seen, queue = {0}, [0]
    for k in queue:
        triangle = triangles[k]
        for i in range(3):
            neighbour = sides.get((triangle[(i + 1) % 3], triangle[i]))
            if neighbour is not None and neighbour not in seen:
                seen.add(neighbour)
                queue.append(neighbour)
                tree.add(frozenset((k, neighbour)))
    if len(seen) != len(triangles):
        raise RegionError(
            "region: its triangles are not connected; a region whose corners do not touch each other is needed"
        )
    return tree
