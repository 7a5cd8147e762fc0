"""Geofences of inclusion and exclusion areas, polygons or circles, in plane geometry.

PX4's rule (``Geofence::checkPolygons``): a position is allowed inside at least one inclusion area, if any is defined,
and outside all exclusion areas. The rule ignores altitude.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import PlanItem

Point = tuple[float, float]

_log = logging.getLogger(__name__)
_POLYGONS = (plan.FENCE_INCLUSION, plan.FENCE_EXCLUSION)
_CIRCLES = (plan.FENCE_CIRCLE_INCLUSION, plan.FENCE_CIRCLE_EXCLUSION)
_MIN_VERTICES = 3


def in_polygon(vertices: Sequence[Point], point: Point) -> bool:
    """Return whether ``point`` lies in a polygon (even-odd rule: count the edges crossed by a ray)."""
    x, y = point
    inside = False
    x1, y1 = vertices[-1]
    for x2, y2 in vertices:
        # half-open in y, so that a ray through a vertex crosses exactly one of its two edges
        if (y1 > y) != (y2 > y) and x < (x2 - x1) * (y - y1) / (y2 - y1) + x1:
            inside = not inside
        x1, y1 = x2, y2
    return inside


@dataclass(frozen=True)
class Polygon:
    """Closed polygon; ``vertices`` in m."""

    vertices: tuple[Point, ...]
    inclusion: bool

    def contains(self, point: Point) -> bool:
        """Return whether ``point`` (m) is inside."""
        return in_polygon(self.vertices, point)


@dataclass(frozen=True)
class Circle:
    """Circle; centre and radius in m."""

    centre: Point
    radius: float
    inclusion: bool

    def contains(self, point: Point) -> bool:
        """Return whether ``point`` (m) is inside."""
        return math.hypot(point[0] - self.centre[0], point[1] - self.centre[1]) < self.radius


@dataclass(frozen=True)
class Fence:
    """Areas of a geofence."""

    areas: tuple[Polygon | Circle, ...] = ()

    def allows(self, point: Point) -> bool:
        """Return whether the fence allows ``point`` (m)."""
        included, wanted = False, False
        for area in self.areas:
            if area.inclusion:
                wanted = True
                included = included or area.contains(point)
            elif area.contains(point):
                return False
        return included or not wanted


def build(items: Sequence[PlanItem], to_plane: Callable[[float, float], Point]) -> Fence:
    """Return the fence defined by ``items``.

    Polygons with too few or missing vertices and unsupported commands are skipped with a warning. Return points are
    accepted without effect, as in PX4.

    Args:
        items: items of the fence list.
        to_plane: converts latitude and longitude, degrees, to a point in m.
    """
    areas: list[Polygon | Circle] = []
    i = 0
    while i < len(items):
        item = items[i]
        count = 1
        if item.command in _CIRCLES:
            centre = to_plane(item.x, item.y)
            areas.append(Circle(centre, item.params[0], item.command == plan.FENCE_CIRCLE_INCLUSION))
        elif item.command in _POLYGONS:
            count = max(vertex_count(item), 1)
            corners = items[i : i + count]
            if count < _MIN_VERTICES or any(c.command != item.command for c in corners) or len(corners) < count:
                _log.warning("geofence: item %d skipped: %d vertices do not form a polygon", i, len(corners))
            else:
                vertices = tuple(to_plane(c.x, c.y) for c in corners)
                areas.append(Polygon(vertices, item.command == plan.FENCE_INCLUSION))
        elif item.command != plan.FENCE_RETURN_POINT:
            _log.warning("geofence: item %d skipped: command %d does not define a fence", i, item.command)
        i += count
    return Fence(tuple(areas))


def vertex_count(item: PlanItem) -> int:
    """Return the number of polygon vertices declared by ``item``; 0 for an invalid number."""
    count = item.params[0]
    return int(count + 0.5) if 0.0 <= count <= plan.CAPACITY[plan.FENCE] else 0
