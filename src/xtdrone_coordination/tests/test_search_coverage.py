"""Coverage paths: ground seen along them, turns, and the planned footprint."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import shapely
import shapely.affinity
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_coordination.search.planning.coverage_path import (
    PERSON,
    CoverageOptions,
    ImageFootprint,
    cover,
    footprint,
    lane_outlines,
    length,
    sweep,
    turns,
)

CAMERA = Pinhole.of_view(640, 360, 2.0)
SEEN = footprint(CAMERA, 12.0, -60.0)
NARROW = ImageFootprint(height=10.0, near=2.0, far=12.0, half_near=5.0, half_far=7.0)
OPTIONS = CoverageOptions()


def _projected(ahead: float, side: float, up: float, height: float, pitch: float) -> tuple[float, float]:
    """Return the pixel of a point by the camera's projection."""
    down = math.radians(-pitch)
    below = height - up
    optical = [
        [-side, below * math.cos(down) - ahead * math.sin(down), ahead * math.cos(down) + below * math.sin(down)]
    ]
    return tuple(CAMERA.project(np.array(optical))[0])


@pytest.mark.parametrize(
    ("height", "pitch"), [(8.0, -60.0), (12.0, -60.0), (12.0, -40.0), (17.0, -60.0), (15.0, -80.0)]
)
def test_people_in_the_footprint_are_large_enough_and_whole(height: float, pitch: float) -> None:
    seen = footprint(CAMERA, height, pitch, pixels=12.0, margin=0.0)
    for ahead in np.linspace(seen.near, seen.far, 7):
        for side in (-1.0, 0.0, 1.0):
            u, v = _projected(ahead, side * seen.half_at(ahead), 0.0, height, pitch)
            _, head = _projected(ahead, side * seen.half_at(ahead), PERSON, height, pitch)
            assert v - head >= 12.0 - 1e-6
            assert head >= -1e-6
            assert v <= 360.0 + 1e-6
            assert -1e-6 <= u <= 640.0 + 1e-6
    beyond = seen.far + 0.1
    v, head = (_projected(beyond, 0.0, up, height, pitch)[1] for up in (0.0, PERSON))
    assert v - head < 12.0 or head < 0.0 or beyond > 30.0


def test_a_height_from_which_people_are_too_small_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"height: 120 m: .* at most \d px high, at least 12 px"):
        footprint(CAMERA, 120.0, -60.0)
    with pytest.raises(ValueError, match=r"gimbal_pitch: 10\.0 is not allowed, -90 to -5 deg"):
        footprint(CAMERA, 12.0, 10.0)
    with pytest.raises(ValueError, match=r"overlap: 0\.9 is not allowed"):
        CoverageOptions(overlap=0.9)


@pytest.mark.parametrize("side", [4.0, 60.0])
def test_the_outlines_of_the_lanes_hold_what_is_seen_along_them(side: float) -> None:
    """Of a small piece too, whose lane lies outside it, because the camera looks ahead."""
    piece = Polygon([(0, 0), (side, 0), (side, side), (0, side)])
    path = cover(piece, NARROW, OPTIONS)
    outlines = [Polygon(corners) for corners in lane_outlines(path, NARROW)]
    assert len(outlines) == len(path) / 2
    for outline, a, b in zip(outlines, path[::2], path[1::2], strict=True):
        seen = sweep([a, b], NARROW, 0.1)
        assert outline.symmetric_difference(seen).area < 5e-3 * seen.area
    assert shapely.union_all(outlines).buffer(1e-6).contains(piece)


def _share_seen(piece: Polygon, seen: ImageFootprint, options: CoverageOptions) -> float:
    return sweep(cover(piece, seen, options), seen, 1.0).intersection(piece).area / piece.area


SHAPES = {
    "square": Polygon([(0, 0), (70, 0), (70, 70), (0, 70)]),
    "long": Polygon([(0, 0), (200, 50), (195, 70), (-5, 20)]),
    "bay": Polygon([(0, 0), (120, 0), (120, 80), (90, 80), (90, 20), (30, 20), (30, 80), (0, 80)]),
    "hole": Polygon([(0, 0), (150, 0), (150, 90), (0, 90)], [[(50, 20), (110, 20), (110, 70), (50, 70)]]),
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("seen", [SEEN, NARROW], ids=["wide", "narrow"])
def test_everything_is_seen(name: str, seen: ImageFootprint) -> None:
    assert _share_seen(SHAPES[name], seen, OPTIONS) > 0.9999


@st.composite
def pieces(draw: st.DrawFn) -> Polygon:
    corners = draw(st.integers(3, 10))
    radii = draw(st.lists(st.floats(10.0, 60.0), min_size=corners, max_size=corners))
    angles = np.arange(corners) * 2.0 * math.pi / corners + draw(st.floats(0.0, 1.0))
    shell = Polygon([(r * math.cos(a), r * math.sin(a)) for r, a in zip(radii, angles, strict=True)])
    hole = draw(st.floats(0.0, 8.0))
    return shell.difference(shapely.Point(0.0, 0.0).buffer(hole)) if hole > 1.0 and corners > 4 else shell


@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(pieces(), st.floats(8.0, 18.0), st.floats(-75.0, -35.0), st.floats(0.0, 0.4))
def test_any_piece_is_seen_from_any_height(piece: Polygon, height: float, pitch: float, overlap: float) -> None:
    parts = [part for part in shapely.get_parts(piece) if isinstance(part, Polygon)]
    seen = footprint(CAMERA, height, pitch, pixels=8.0)
    assert _share_seen(max(parts, key=lambda part: part.area), seen, CoverageOptions(overlap=overlap)) > 0.99


def test_lanes_of_a_rectangle_are_the_fewest_and_begin_before_it() -> None:
    options = CoverageOptions(overlap=0.0, depth=10.0)
    path = cover(Polygon([(0, 0), (100, 0), (100, 29), (0, 29)]), NARROW, options, home=(0.0, 0.0))
    assert len(path) == 6  # three lanes of ten metres width for 29 m
    assert turns(path) == 4
    lanes = [(path[i], path[i + 1]) for i in range(0, 6, 2)]
    for a, b in lanes:
        sense = 1.0 if b.x > a.x else -1.0
        first, last = (0.0, 100.0) if sense > 0 else (100.0, 0.0)
        assert a.x == pytest.approx(first - sense * NARROW.far)
        assert b.x == pytest.approx(last - sense * NARROW.near)
        assert a.heading == b.heading
        assert math.cos(a.heading) == pytest.approx(sense)
    assert sorted(a.y for a, _ in lanes) == pytest.approx([29 / 6, 29 / 2, 29 * 5 / 6])
    assert length(path) == pytest.approx(3 * 110.0 + 2 * math.hypot(29 / 3, NARROW.far + NARROW.near), abs=0.1)


def test_lanes_lie_across_the_least_width() -> None:
    slim = Polygon([(0, 0), (150, 0), (150, 24), (0, 24)])
    for angle in (0.0, 0.4, 1.9):
        path = cover(shapely.affinity.rotate(slim, angle, origin=(0, 0), use_radians=True), NARROW, OPTIONS)
        assert math.sin(path[0].heading - angle) == pytest.approx(0.0, abs=1e-6)


def test_two_wings_far_apart_are_flown_one_after_the_other() -> None:
    wings = Polygon([(0, 0), (400, 0), (400, 60), (350, 60), (350, 5), (50, 5), (50, 60), (0, 60)])
    path = cover(wings, NARROW, OPTIONS)
    sides = ["left" if w.x < 200 else "right" for w in path if w.y > 8.0]
    changes = sum(a != b for a, b in pairwise(sides))
    assert changes <= 2
    assert sweep(path, NARROW).intersection(wings).area > 0.9999 * wings.area
