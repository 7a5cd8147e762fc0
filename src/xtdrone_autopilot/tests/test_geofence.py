"""Geofence geometry against the winding number and a direct implementation of PX4's rule."""

from __future__ import annotations

import cmath
import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from xtdrone_autopilot.navigator import geofence, plan
from xtdrone_autopilot.navigator.geofence import Circle, Fence, Polygon
from xtdrone_autopilot.navigator.plan import PlanItem

coordinate = st.floats(-100.0, 100.0, allow_nan=False).map(lambda v: round(v, 3))
point = st.tuples(coordinate, coordinate)


def star(centre, radii):
    """Return a simple polygon: corners at even angles round ``centre``."""
    step = 2 * math.pi / len(radii)
    return tuple((centre[0] + r * math.cos(i * step), centre[1] + r * math.sin(i * step)) for i, r in enumerate(radii))


polygon = st.builds(star, point, st.lists(st.floats(1.0, 80.0), min_size=3, max_size=12))


def winding_number(vertices, p):
    """Return the winding number of the polygon around ``p``: the sum of the angles subtended by its edges."""
    rays = [complex(x - p[0], y - p[1]) for x, y in vertices]
    turned = sum(cmath.phase(after / before) for before, after in zip(rays, rays[1:] + rays[:1], strict=True))
    return round(turned / (2 * math.pi))


def distance_to_edges(vertices, p):
    found = math.inf
    for (x1, y1), (x2, y2) in zip(vertices, vertices[1:] + vertices[:1], strict=True):
        dx, dy = x2 - x1, y2 - y1
        along = ((p[0] - x1) * dx + (p[1] - y1) * dy) / (dx * dx + dy * dy)
        along = min(max(along, 0.0), 1.0)
        found = min(found, math.hypot(p[0] - x1 - along * dx, p[1] - y1 - along * dy))
    return found


@given(polygon, point)
@settings(max_examples=400, deadline=None, derandomize=True)
def test_inside_a_polygon_is_where_it_winds_round(vertices, p):
    assume(distance_to_edges(vertices, p) > 1e-6)
    assert geofence.in_polygon(vertices, p) is (winding_number(vertices, p) != 0)


@given(polygon, point, st.integers(0, 11))
@settings(max_examples=200, deadline=None, derandomize=True)
def test_order_and_first_corner_do_not_matter(vertices, p, turn):
    assume(distance_to_edges(vertices, p) > 1e-6)
    inside = geofence.in_polygon(vertices, p)
    turn %= len(vertices)
    assert geofence.in_polygon(vertices[turn:] + vertices[:turn], p) is inside
    assert geofence.in_polygon(vertices[::-1], p) is inside


area = st.one_of(
    st.builds(Polygon, polygon, st.booleans()), st.builds(Circle, point, st.floats(1.0, 80.0), st.booleans())
)


@given(st.lists(area, max_size=5), point)
@settings(max_examples=300, deadline=None, derandomize=True)
def test_a_place_is_allowed_in_any_inclusion_and_no_exclusion(areas, p):
    inclusions = [a for a in areas if a.inclusion]
    exclusions = [a for a in areas if not a.inclusion]
    allowed = not any(a.contains(p) for a in exclusions)
    if inclusions:
        allowed = allowed and any(a.contains(p) for a in inclusions)
    assert Fence(tuple(areas)).allows(p) is allowed


def fence_item(command, x, y, param=0.0):
    return PlanItem(command, 6, (param, 0.0, 0.0, 0.0), x, y, 0.0)


def plane(latitude, longitude):
    return latitude, longitude


def test_items_make_areas():
    items = [
        fence_item(plan.FENCE_RETURN_POINT, 0, 0),
        *(fence_item(plan.FENCE_INCLUSION, x, y, 4) for x, y in ((0, 0), (10, 0), (10, 10), (0, 10))),
        fence_item(plan.FENCE_CIRCLE_EXCLUSION, 5, 5, 2),
        *(fence_item(plan.FENCE_EXCLUSION, x, y, 3) for x, y in ((0, 0), (2, 0), (0, 2))),
    ]
    fence = geofence.build(items, plane)
    assert len(fence.areas) == 3
    assert fence.allows((8.0, 8.0))
    assert not fence.allows((5.0, 5.0))
    assert not fence.allows((0.5, 0.5))
    assert not fence.allows((11.0, 5.0))


@pytest.mark.parametrize(
    "items",
    [
        [fence_item(plan.WAYPOINT, 1, 1)],
        [fence_item(plan.FENCE_INCLUSION, 1, 1, 0)],
        [fence_item(plan.FENCE_INCLUSION, 1, 1, math.nan)],
        [fence_item(plan.FENCE_INCLUSION, x, x, 3) for x in range(2)],
        [fence_item(plan.FENCE_INCLUSION, x, x, 2) for x in range(2)],
        [fence_item(plan.FENCE_INCLUSION, 0, 0, 3), *(fence_item(plan.FENCE_EXCLUSION, x, 1, 3) for x in range(2))],
    ],
)
def test_degenerate_areas_are_skipped_with_a_warning(items, caplog):
    assert geofence.build(items[:2], plane).areas == ()
    assert "skipped" in caplog.text
