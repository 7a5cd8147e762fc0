"""QGroundControl's structure scan: a camera's flight around a building, in layers.

A .plan file has the outline and the settings of a structure scan, but not its items, unlike those of other patterns;
here they are built as QGroundControl builds them (``StructureScanComplexItem::appendMissionItems``,
``QGCMapPolygon::offset``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import FRAME_MISSION, PlanItem
from xtdrone_common.geodesy import projection

_RELATIVE = 3  # MAV_FRAME
_TOWARDS_STRUCTURE = 90.0  # degrees, the camera's direction from that of a clockwise flight

Place = tuple[float, float]


@dataclass(frozen=True)
class StructureScan:
    """A structure scan.

    Attributes:
        outline: corners of the structure: latitude, longitude, degrees; at least three different ones.
        distance: of the path from the outline, m.
        entrance: height of the first and the last waypoint, m above home.
        bottom, top: lower and upper end of the scan, m above home.
        layers: number of layers.
        layer_height: height of a picture on the structure, m.
        trigger_distance: distance between two pictures, m.
        pitch: of the camera, degrees.
        from_top: whether the highest layer is the first.
    """

    outline: tuple[Place, ...]
    distance: float
    entrance: float
    bottom: float
    top: float
    layers: int
    layer_height: float
    trigger_distance: float
    pitch: float
    from_top: bool

    @staticmethod
    def length(layers: int, corners: int) -> int:
        """Return the number of mission items of a scan."""
        return layers * (corners + 3) + 4

    def items(self) -> list[PlanItem]:
        """Return the mission items of the scan."""
        path = _offset(self.outline, self.distance)
        ring = [*path, path[0]]
        found = [_waypoint(path[0], self.entrance), _command(plan.SET_ROI_NEXT, x=self.pitch, z=_TOWARDS_STRUCTURE)]
        height, step = (self.top, -self.layer_height) if self.from_top else (self.bottom, self.layer_height)
        for layer in range(self.layers):
            first, *others = [_waypoint(corner, height + (layer + 0.5) * step) for corner in ring]
            start = _command(plan.TRIGGER_DISTANCE, self.trigger_distance, now=1.0)
            found += [first, start, *others, _command(plan.TRIGGER_DISTANCE)]
        return [*found, _command(plan.SET_ROI_NONE), _waypoint(path[0], self.entrance)]


def _waypoint(place: Place, height: float) -> PlanItem:
    return PlanItem(plan.WAYPOINT, _RELATIVE, (0.0, 0.0, 0.0, math.nan), *place, height)


def _command(command: int, first: float = 0.0, *, now: float = 0.0, x: float = 0.0, z: float = 0.0) -> PlanItem:
    return PlanItem(command, FRAME_MISSION, (first, 0.0, now, 0.0), x, 0.0, z)


def _offset(outline: Sequence[Place], distance: float) -> list[Place]:
    """Return a clockwise polygon whose edges are ``distance`` (m) outside those of ``outline`` (degrees)."""
    origin = outline[0]
    corners = _different([projection.project(*corner, *origin) for corner in outline])
    if _doubled_area(corners) < 0.0:
        corners.reverse()
    edges = [_outside(a, b, distance) for a, b in pairwise([*corners, corners[0]])]
    moved = [_crossing(before, after) for before, after in pairwise([edges[-1], *edges])]
    return [projection.reproject(north, east, *origin) for north, east in moved]


def different_corners(outline: Sequence[Place]) -> int:
    """Return the number of corners (degrees) that are not where the one before is."""
    return len(_different([projection.project(*corner, *outline[0]) for corner in outline]))


def _different(corners: Sequence[Place]) -> list[Place]:
    return [b for a, b in pairwise([corners[-1], *corners]) if math.dist(a, b) > 1e-3]


def _doubled_area(corners: Sequence[Place]) -> float:
    """Return twice the area, m^2, of a polygon of norths and easts; positive for a clockwise one."""
    return sum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise([*corners, corners[0]]))


def _outside(a: Place, b: Place, distance: float) -> tuple[Place, Place]:
    """Return an edge (north, east, m) of a clockwise polygon, moved outwards."""
    length = math.dist(a, b)
    north, east = (b[1] - a[1]) / length * distance, -(b[0] - a[0]) / length * distance
    return (a[0] + north, a[1] + east), (b[0] + north, b[1] + east)


def _crossing(before: tuple[Place, Place], after: tuple[Place, Place]) -> Place:
    """Return the point at which the lines of two edges cross; their common end where they are parallel."""
    (a, b), (c, d) = before, after
    u, v = (b[0] - a[0], b[1] - a[1]), (d[0] - c[0], d[1] - c[1])
    across = u[0] * v[1] - u[1] * v[0]
    if abs(across) < 1e-6 * math.hypot(*u) * math.hypot(*v):
        return c
    share = ((c[0] - a[0]) * v[1] - (c[1] - a[1]) * v[0]) / across
    return a[0] + share * u[0], a[1] + share * u[1]
