"""Division of regions: equal areas, connected, no overlap, no gap, for any shape."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import shapely
import shapely.affinity
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from xtdrone_coordination.search.planning import region as regions
from xtdrone_coordination.search.planning.region import (
    RegionError,
    divide,
    make_region,
    parse_region,
    read_region,
    region_data,
)

SQUARE = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]


def _circle(radius: float, corners: int, x: float = 0.0, y: float = 0.0) -> list[tuple[float, float]]:
    angles = np.linspace(0.0, 2.0 * math.pi, corners, endpoint=False)
    return [(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles]


def _spiral() -> list[tuple[float, float]]:
    angles = np.linspace(0.0, 6.0 * math.pi, 60)
    inner, outer = ([((10 + w + 5 * a) * math.cos(a), (10 + w + 5 * a) * math.sin(a)) for a in angles] for w in (0, 8))
    return inner + outer[::-1]


def _comb() -> list[tuple[float, float]]:
    teeth = [
        (10.0 * k + x, y) for k in range(9, -1, -1) for x, y in ((5.0, 5.0), (5.0, 100.0), (0.0, 100.0), (0.0, 5.0))
    ]
    return [(0.0, 0.0), (95.0, 0.0), *teeth[1:-1]]


SHAPES = {
    "square": make_region(SQUARE),
    "holes": make_region(SQUARE, [[(20, 20), (50, 20), (50, 40), (20, 40)], _circle(15, 12, 70, 70)]),
    "comb": make_region(_comb()),
    "spiral": make_region(_spiral()),
    "thin ring": make_region(_circle(50, 40), [_circle(49, 40)]),
    "star": make_region([(s * x, s * y) for s, (x, y) in zip([0.05, 1.0] * 7, _circle(100, 14), strict=True)]),
    "sliver": make_region([(0, 0), (1000, 0), (1000, 0.01), (0, 0.02)]),
    "far away": shapely.affinity.translate(make_region(SQUARE), 1e6, -2e6),
}


def check(region: Polygon, pieces: list[Polygon], count: int, equal: float = 1e-6) -> None:
    assert len(pieces) == count
    for piece in pieces:
        assert isinstance(piece, Polygon)  # a valid polygon is connected
        assert piece.is_valid
        assert piece.area == pytest.approx(region.area / count, rel=equal)
    together = shapely.union_all(pieces)
    assert together.symmetric_difference(region).area < 1e-6 * region.area
    assert sum(piece.area for piece in pieces) - together.area < 1e-6 * region.area


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("count", [1, 2, 6, 13])
def test_pieces_are_equal_connected_and_together_the_region(name: str, count: int) -> None:
    check(SHAPES[name], divide(SHAPES[name], count), count)


@st.composite
def polygons(draw: st.DrawFn) -> Polygon:
    """Return a polygon with corners at random distances from a point, and holes in some of its triangles."""
    corners = draw(st.integers(3, 14))
    radii = draw(st.lists(st.floats(0.05, 1.0), min_size=corners, max_size=corners))
    turn = draw(st.floats(0.0, 1.0))
    scale = draw(st.sampled_from([0.1, 1.0, 30.0, 1000.0]))
    angles = (np.arange(corners) + turn) * 2.0 * math.pi / corners
    shell = [(scale * r * math.cos(a), scale * r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]
    holes = []
    for body in shapely.get_parts(shapely.constrained_delaunay_triangles(Polygon(shell))):
        if body.area > 0.01 * body.length**2 and len(holes) < 3 and draw(st.booleans()):
            share = draw(st.floats(0.1, 0.9))
            holes.append(shapely.affinity.scale(body, share, share, origin="centroid").exterior.coords[:-1])
    return make_region(shell, holes)


@settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(polygons(), st.integers(1, 30))
def test_any_polygon_falls_into_any_number_of_pieces(region: Polygon, count: int) -> None:
    check(region, divide(region, count), count)


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(polygons(), st.integers(2, 12))
def test_arcs_of_the_band_around_the_triangles_are_as_good(region: Polygon, count: int) -> None:
    """Regions have area 1, as ``divide`` normalises them."""
    scale = math.sqrt(region.area)
    here = shapely.transform(shapely.orient_polygons(region), lambda xy: (xy - region.bounds[:2]) / scale)
    check(here, regions._arcs(here, count), count)


def test_pieces_of_a_compact_region_are_compact() -> None:
    for count in (2, 4, 6, 9):
        for piece in divide(SHAPES["square"], count):
            assert 4.0 * math.pi * piece.area / piece.length**2 > 0.6  # a square has 0.79, one of 1:2 has 0.70


def test_the_same_region_is_divided_equally() -> None:
    one, two = (divide(SHAPES["holes"], 7) for _ in range(2))
    assert [piece.wkb for piece in one] == [piece.wkb for piece in two]


@pytest.mark.parametrize(
    ("corners", "holes", "what"),
    [
        ([(0, 0), (10, 10), (10, 0), (0, 10)], [], r"region: Self-intersection.*does not cross"),
        (SQUARE, [[(90, 90), (110, 90), (110, 110)]], r"holes\[0\]: it is not inside"),
        (SQUARE, [[(10, 10), (30, 10), (20, 30)], [(20, 10), (40, 10), (30, 30)]], "holes: .*overlap"),
        ([(0, 0), (1, 1), (2, 2)], [], "region: .*(crosses?|cross|area)"),
        ([(0, 0), (1, 1)], [], "2 different corners are not allowed, at least 3"),
        ([(0, 0), (1, math.nan), (2, 0)], [], "not finite"),
        ([(0, 0), (1, "a"), (2, 0)], [], "numbers in m"),
        (7, [], "a list of corners"),
    ],
)
def test_invalid_regions_are_rejected(corners: list, holes: list, what: str) -> None:
    with pytest.raises(RegionError, match=what):
        make_region(corners, holes)


@pytest.mark.parametrize("count", [0, -1, 251, 2.0, True])
def test_invalid_numbers_of_pieces_are_rejected(count: int) -> None:
    with pytest.raises(RegionError, match=r"pieces: .* is not allowed, 1 to 250"):
        divide(SHAPES["square"], count)


def test_files(tmp_path: Path) -> None:
    path = tmp_path / "region.yaml"
    path.write_text(
        "region: [[0, 0], [100, 0], [100, 50]]\nholes: [[[60, 10], [80, 10], [80, 20]]]\n", encoding="utf-8"
    )
    region = read_region(path)
    assert region.area == pytest.approx(2500.0 - 100.0)
    assert parse_region(region_data(region)).equals(region)
    path.write_text("polygon: []\n", encoding="utf-8")
    with pytest.raises(RegionError, match=r"region.yaml: region: a mapping"):
        read_region(path)
    with pytest.raises(RegionError, match="unknown key 'hole'"):
        parse_region({"region": SQUARE, "hole": []})
