"""Whether a mission can be flown: PX4 v1.14's checks for a multicopter, with its texts (``FeasibilityChecker``)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from xtdrone_control.autopilot.events.events import ERROR, WARNING
from xtdrone_control.autopilot.flight_tasks.auto_setpoint import CRITICAL
from xtdrone_control.autopilot.navigator import plan
from xtdrone_control.autopilot.navigator.plan import Items, PlanItem
from xtdrone_control.geodesy import geo

_FLOWN = plan.POSITION_COMMANDS | {
    plan.RETURN,
    plan.DELAY,
    plan.CONDITION_GATE,
    plan.WINCH,
    plan.GRIPPER,
    plan.JUMP,
    plan.CHANGE_SPEED,
    plan.SET_HOME,
    plan.LAND_START,
    plan.TRIGGER_CONTROL,
    plan.DIGICAM_CONTROL,
    plan.START_IMAGES,
    plan.STOP_IMAGES,
    plan.START_VIDEO,
    plan.STOP_VIDEO,
    plan.CONTROL_VIDEO,
    plan.MOUNT_CONFIGURE,
    plan.MOUNT_CONTROL,
    plan.GIMBAL_PITCHYAW,
    plan.GIMBAL_CONFIGURE,
    plan.SET_ACTUATOR,
    plan.SET_ROI,
    plan.SET_ROI_LOCATION,
    plan.SET_ROI_NEXT,
    plan.SET_ROI_NONE,
    plan.TRIGGER_DISTANCE,
    plan.OBLIQUE_SURVEY,
    plan.TRIGGER_INTERVAL,
    plan.CAMERA_MODE,
    plan.CAMERA_ZOOM,
    plan.CAMERA_FOCUS,
    plan.VTOL_TRANSITION,
}
_VTOL = (plan.VTOL_TAKEOFF, plan.VTOL_LAND, plan.VTOL_TRANSITION)
_TAKEOFFS = (plan.TAKEOFF, plan.VTOL_TAKEOFF)
# items before a takeoff that do not make it late: all that are flown but those with a place, and the odd ones out
_BEFORE_TAKEOFF = _FLOWN - plan.POSITION_COMMANDS - {plan.RETURN, plan.CONDITION_GATE, plan.SET_ACTUATOR}
_EPSILON = 1e-6
_LEAST_GATE_DISTANCE = 0.05  # m


@dataclass(frozen=True)
class Situation:
    """What the checks need to know of the vehicle.

    Attributes:
        home_altitude: m AMSL; NaN without a home.
        place: latitude and longitude, degrees.
        landed: whether it stands on the ground.
        first_distance: MIS_DIST_1WP, m.
        required: MIS_TKO_LAND_REQ.
        fence_allows: whether the geofence allows a place: latitude, longitude, m AMSL.
    """

    home_altitude: float
    place: tuple[float, float]
    landed: bool
    first_distance: float
    required: int
    fence_allows: Callable[[float, float, float], bool]


class Problem:
    """What speaks against a mission: PX4's text, and the event that says the same with its arguments."""

    def __init__(self, text: str, name: str, *values: float) -> None:
        """Keep what is to be told."""
        self._text = text
        self._name = name
        self._values = values

    def tell(self, tell: Callable[..., None]) -> None:
        """Tell it, see ``check``."""
        tell(CRITICAL, self._text, self._name, *self._values, level=ERROR)


def _distance(a: PlanItem, place: tuple[float, float]) -> float:
    if not (math.isfinite(a.x) and math.isfinite(a.y)):
        return math.inf
    return math.hypot(*geo.project(a.x, a.y, *place))


def _invalid(items: Items, now: Situation) -> Problem | None:
    """Return what makes an item of ``items`` no item at all."""
    for i, item in enumerate(items):
        if item.has_position and item.relative and math.isnan(now.home_altitude):
            text = f"Mission rejected: No home pos, WP {i + 1} uses rel alt"
            return Problem(text, "navigator_mis_no_home_rel_alt", i + 1)
        if item.command not in _FLOWN:
            text = f"Mission rejected: item {i + 1}: unsupported cmd: {item.command}"
            return Problem(text, "navigator_mis_unsup_cmd", i + 1, item.command)
    if items[0].command == plan.LAND and now.landed:
        return Problem("Mission rejected: starts with landing", "navigator_mis_starts_w_landing")
    return None


def _gate(items: Items, _now: Situation) -> Problem | None:
    before: PlanItem | None = None
    for item in items:
        if not item.has_position and item.command != plan.CONDITION_GATE:
            continue
        if before is not None and plan.CONDITION_GATE in (item.command, before.command):
            distance = _distance(item, (before.x, before.y))
            if distance < _LEAST_GATE_DISTANCE:
                text = f"Distance between waypoint and gate too close: {int(distance)} meters"
                return Problem(text, "navigator_mis_wp_gate_too_close", distance, _LEAST_GATE_DISTANCE)
        before = item
    return None


def _first(items: Items, now: Situation) -> Problem | None:
    item = next((item for item in items if item.has_position), None)
    if item is None or now.first_distance <= _EPSILON:
        return None
    distance = _distance(item, now.place)
    if distance < now.first_distance:
        return None
    if math.isnan(distance):  # nobody knows where the vehicle is
        return None
    text = f"First waypoint too far away: {math.floor(min(distance, 2e9))}m, {int(now.first_distance)} max"
    return Problem(text, "navigator_mis_first_wp_too_far", distance, now.first_distance)


def _takeoff(items: Items, now: Situation) -> Problem | None:
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


def _vtol(items: Items, _now: Situation) -> Problem | None:
    if any(item.command in _VTOL for item in items):
        text = "Mission rejected: Mission contains VTOL items but vehicle is not a VTOL"
        return Problem(text, "navigator_mis_vtol")
    return None


def _required(items: Items, now: Situation) -> Problem | None:
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


def _fence(items: Items, now: Situation) -> Problem | None:
    for i, item in enumerate(items):
        if item.has_position and not now.fence_allows(item.x, item.y, item.altitude(now.home_altitude)):
            return Problem(f"Geofence violation for waypoint {i + 1}", "navigator_mis_geofence_violation", i + 1)
    return None


_CHECKS = (_gate, _first, _takeoff, _vtol, _required, _fence)


def check(items: Items, now: Situation, tell: Callable[..., None]) -> bool:
    """Return whether the mission ``items`` can be flown.

    Args:
        items: the mission.
        now: what the vehicle is about.
        tell: takes what speaks against it, as ``Announcements.tell``.
    """
    if not items:
        return False
    invalid = _invalid(items, now)
    if invalid is not None:
        invalid.tell(tell)
        return False
    for i, item in enumerate(items):
        if item.has_position and item.altitude(now.home_altitude) < now.home_altitude:
            text = f"Warning: Waypoint {i + 1} below home"
            tell(CRITICAL, text, "navigator_mis_wp_below_home", i + 1, level=WARNING)
    found = [problem for problem in (one(items, now) for one in _CHECKS) if problem is not None]
    for problem in found:
        problem.tell(tell)
    return not found
