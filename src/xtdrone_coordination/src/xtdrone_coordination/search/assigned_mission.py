"""The mission assigned to a searching vehicle: its items, the path they make, and the progress along it."""

from __future__ import annotations

import math

from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import Items
from xtdrone_common.geodesy.projection import Datum

from .planning.coverage_path import Point, Waypoint
from .planning.plans import waypoint_item

_ENDS = (plan.RETURN, plan.LAND)
_NO_PATH = (plan.TAKEOFF, plan.LAND, plan.VTOL_TAKEOFF, plan.VTOL_LAND)


class AssignedMission:
    """The mission of a vehicle and the progress along its path.

    Attributes:
        items: the mission items.
        path: waypoints with the indices of their items.
        current: index of the item being flown.
        reached: index of the last item reached, -1 for none.
        progress: item and position at the newest image taken on the path; None before the first.
    """

    def __init__(self, datum: Datum) -> None:
        self.items: Items = ()
        self.path: list[tuple[int, Waypoint]] = []
        self.current = 0
        self.reached = -1
        self.progress: tuple[int, Point] | None = None
        self._datum = datum

    def load(self, items: Items) -> None:
        """Replace the mission items."""
        self.items = items
        self.path = _path(items, self._datum)

    @property
    def height(self) -> float:
        """Search height over home, m: the greatest of the mission."""
        heights = [self._height_of(index) for index, item in enumerate(self.items) if item.has_position]
        return max(heights, default=0.0)

    @property
    def takeoff_height(self) -> float:
        """Height at the end of the takeoff, m over home."""
        heights = [item.z for item in self.items if item.command == plan.TAKEOFF and item.relative]
        return min([*heights[:1], self.height])

    @property
    def lowest(self) -> float:
        """Minimum height of the path, m over home."""
        return min((self._height_of(index) for index, _ in self.path), default=self.height)

    def _height_of(self, index: int) -> float:
        item = self.items[index]
        return item.z if item.relative else item.z - self._datum.altitude

    @property
    def end(self) -> int:
        """Index of the item that ends the path."""
        ends = [i for i, item in enumerate(self.items) if item.command in _ENDS and i > 0]
        return ends[-1] if ends else len(self.items)

    @property
    def path_done(self) -> bool:
        """Whether the path has been flown."""
        return bool(self.items) and (self.current >= self.end or self.reached >= len(self.items) - 1)

    @property
    def ended(self) -> bool:
        """Whether a mission that does not end with a return or landing has been flown."""
        return self.path_done and self.end >= len(self.items) and self.reached >= len(self.items) - 1

    @property
    def first_waypoint(self) -> int:
        """Index of the first item of the path, 0 without a path."""
        return self.path[0][0] if self.path else 0

    @property
    def unseen_path(self) -> list[Waypoint]:
        """Part of the path no image has been taken on; empty or a single waypoint if there is none."""
        if self.progress is None:
            return [waypoint for _, waypoint in self.path]
        current, (x, y) = self.progress
        left = [waypoint for index, waypoint in self.path if index >= current]
        if left and len(left) < len(self.path):
            left.insert(0, Waypoint(x, y, left[0].heading))
        return left

    def extend(self, part: list[Waypoint], *, restart: bool) -> tuple[Items, int]:
        """Return the mission with a part of another vehicle's path appended, and the item to continue with.

        Args:
            part: waypoints to append.
            restart: Whether the vehicle has landed: drop the own path, keep the items before it and fly ``part`` alone.
        """
        first = self.path[0][0] if self.path else len(self.items)
        added = tuple(waypoint_item(waypoint, self.height, self._datum) for waypoint in part)
        before = self.items[: first if restart else self.end]
        return (*before, *added, *self.items[self.end :]), 0 if restart else min(self.current, self.end)


def _path(items: Items, datum: Datum) -> list[tuple[int, Waypoint]]:
    """Return the waypoints of a mission with the indices of their items."""
    places = [
        (i, *datum.local(item.x, item.y), item.yaw)
        for i, item in enumerate(items)
        if item.has_position and item.command not in _NO_PATH
    ]
    path = []
    for k, (i, x, y, yaw) in enumerate(places):
        if math.isfinite(yaw):
            heading = 0.5 * math.pi - yaw
        else:  # the vehicle looks in the direction of flight
            a, b = (places[k - 1], places[k]) if k else (places[0], places[min(1, len(places) - 1)])
            heading = math.atan2(b[2] - a[2], b[1] - a[1])
        path.append((i, Waypoint(x, y, heading)))
    return path
