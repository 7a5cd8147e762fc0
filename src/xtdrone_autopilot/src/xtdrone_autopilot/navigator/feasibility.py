"""Mission feasibility checks with the texts of PX4 v1.14's ``FeasibilityChecker`` for multicopters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from xtdrone_autopilot.events.events import ERROR, WARNING
from xtdrone_autopilot.flight_tasks.auto_setpoint import CRITICAL
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.plan import Items, PlanItem
from xtdrone_common.geodesy import projection

_VTOL = (plan.VTOL_TAKEOFF, plan.VTOL_LAND, plan.VTOL_TRANSITION)
_TAKEOFFS = (plan.TAKEOFF, plan.VTOL_TAKEOFF)
# commands allowed before a takeoff: those without a position, with PX4's three exceptions
_BEFORE_TAKEOFF = plan.FLOWN - plan.POSITION_COMMANDS - {plan.RETURN, plan.CONDITION_GATE, plan.SET_ACTUATOR}
_EPSILON = 1e-6
_MIN_GATE_DISTANCE = 0.05  # m


@dataclass(frozen=True)
class Situation:
    """Vehicle state and settings for the checks.

    Attributes:
        home_altitude: altitude of the home position, m AMSL; NaN without one.
        location: latitude and longitude of the vehicle, degrees.
        landed: whether the vehicle is on the ground.
        first_distance: MIS_DIST_1WP, m.
        required: MIS_TKO_LAND_REQ.
        fence_allows: returns whether the geofence allows a latitude, longitude (degrees) and altitude (m AMSL).
    """

    home_altitude: float
    location: tuple[float, float]
    landed: bool
    first_distance: float
    required: int
    fence_allows: Callable[[float, float, float], bool]


class Problem:
    """Reason to reject a mission: PX4's text and the equivalent event."""

    def __init__(self, text: str, name: str, *values: float) -> None:
        """Store ``text`` and the event's ``name`` and arguments ``values``."""
        self._text = text
        self._name = name
        self._values = values

    def announce(self, tell: Callable[..., None]) -> None:
        """Announce the problem through ``tell``; see ``check``."""
        tell(CRITICAL, self._text, self._name, *self._values, level=ERROR)


def _distance(a: PlanItem, location: tuple[float, float]) -> float:
    if not (math.isfinite(a.x) and math.isfinite(a.y)):
        return math.inf
    return math.hypot(*projection.project(a.x, a.y, *location))


def _check_items(items: Items, now: Situation) -> Problem | None:
    """Return the first problem that makes an item invalid, None if all are valid."""
    for i, item in enumerate(items):
        if item.has_position and item.relative and math.isnan(now.home_altitude):
            text = f"Mission rejected: No home pos, WP {i + 1} uses rel alt"
            return Problem(text, "navigator_mis_no_home_rel_alt", i + 1)
        if item.command not in plan.FLOWN:
            text = f"Mission rejected: item {i + 1}: unsupported cmd: {item.command}"
            return Problem(text, "navigator_mis_unsup_cmd", i + 1, item.command)
    if items[0].command == plan.LAND and now.landed:
        return Problem("Mission rejected: starts with landing", "navigator_mis_starts_w_landing")
    return None


def _check_gates(items: Items, _now: Situation) -> Problem | None:
    before: PlanItem | None = None
    for item in items:
        if not item.has_position and item.command != plan.CONDITION_GATE:
            continue
        if before is not None and plan.CONDITION_GATE in (item.command, before.command):
            distance = _distance(item, (before.x, before.y))
            if distance < _MIN_GATE_DISTANCE:
                text = f"Distance between waypoint and gate too close: {int(distance)} meters"
                return Problem(text, "navigator_mis_wp_gate_too_close", distance, _MIN_GATE_DISTANCE)
        before = item
    return None


def _check_first_waypoint(items: Items, now: Situation) -> Problem | None:
    item = next((item for item in items if item.has_position), None)
    if item is None or now.first_distance <= _EPSILON:
        return None
    distance = _distance(item, now.location)
    if distance < now.first_distance:
        return None
    if math.isnan(distance):  # the vehicle's position is unknown
        return None
    text = f"First waypoint too far away: {math.floor(min(distance, 2e9))}m, {int(now.first_distance)} max"
    return Problem(text, "navigator_mis_first_wp_too_far", distance, now.first_distance)


def _check_takeoff(items: Items, now: Situation) -> Problem | None:
    late = False
    for item in items:
        if item.command in _TAKEOFFS:
            if item.altitude(now.home_altitude) - now.home_altitude < _EPSILON:
                text = "Mission rejected: Takeoff altitude below home altitude!"
                return Problem(text, "navigator_mis_takeoff_too_low", 0.0)
            if late:
                text = "Mission rejected: takeoff not first waypoint item"
                return Problem(text, "navigator_mis_takeoff_not_first")
        late = late or item.command not in _BEFORE_TAKEOFF
    return None


def _check_vtol(items: Items, _now: Situation) -> Problem | None:
    if any(item.command in _VTOL for item in items):
        text = "Mission rejected: Mission contains VTOL items but vehicle is not a VTOL"
        return Problem(text, "navigator_mis_vtol")
    return None


def _check_required(items: Items, now: Situation) -> Problem | None:
    takeoff = any(item.command in _TAKEOFFS for item in items)
    landing = any(item.command == plan.LAND for item in items)
    if now.required == 1 and not takeoff:
        return Problem("Mission rejected: Takeoff waypoint required.", "navigator_mis_takeoff_missing")
    if now.required == 2 and not landing:
        return Problem("Mission rejected: Landing waypoint/pattern required.", "navigator_mis_land_missing")
    if now.required == 3 and not (takeoff and landing):
        text = "Mission rejected: Takeoff or Landing item missing."
        return Problem(text, "navigator_mis_takeoff_or_land_missing")
    if now.required == 4 and takeoff and not landing:
        text = "Mission rejected: Add Landing item or remove Takeoff."
        return Problem(text, "navigator_mis_add_land_or_rm_to")
    if now.required == 4 and landing and not takeoff:
        text = "Mission rejected: Add Takeoff item or remove Landing."
        return Problem(text, "navigator_mis_add_to_or_rm_land")
    return None


def _check_fence(items: Items, now: Situation) -> Problem | None:
    for i, item in enumerate(items):
        if item.has_position and not now.fence_allows(item.x, item.y, item.altitude(now.home_altitude)):
            return Problem(f"Geofence violation for waypoint {i + 1}", "navigator_mis_geofence_violation", i + 1)
    return None


_CHECKS = (_check_gates, _check_first_waypoint, _check_takeoff, _check_vtol, _check_required, _check_fence)


def check(items: Items, now: Situation, tell: Callable[..., None]) -> bool:
    """Return whether the mission ``items`` can be flown, and announce every problem.

    Args:
        items: mission items.
        now: vehicle state and settings.
        tell: announces a problem, with the signature of ``Announcements.tell``.
    """
    if not items:
        return False
    invalid = _check_items(items, now)
    if invalid is not None:
        invalid.announce(tell)
        return False
    for i, item in enumerate(items):
        if item.has_position and item.altitude(now.home_altitude) < now.home_altitude:
            text = f"Warning: Waypoint {i + 1} below home"
            tell(CRITICAL, text, "navigator_mis_wp_below_home", i + 1, level=WARNING)
    found = [problem for problem in (one(items, now) for one in _CHECKS) if problem is not None]
    for problem in found:
        problem.announce(tell)
    return not found
