"""Whether a mission can be flown: PX4 v1.14's checks for a multicopter, with its texts (``FeasibilityChecker``)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from . import geo, plan
from .course import CRITICAL, Say
from .plan import Items, PlanItem

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
# items before a take-off that do not make it late: all that are flown but those with a place, and the odd ones out
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


def _distance(a: PlanItem, place: tuple[float, float]) -> float:
    if not (math.isfinite(a.x) and math.isfinite(a.y)):
        return math.inf
    return math.hypot(*geo.project(a.x, a.y, *place))


def _invalid(items: Items, now: Situation) -> str:
    """Return what makes an item of ``items`` no item at all, or an empty text."""
    for i, item in enumerate(items):
        if item.has_position and item.relative and math.isnan(now.home_altitude):
            return f"Mission rejected: No home pos, WP {i + 1} uses rel alt"
        if item.command not in _FLOWN:
            return f"Mission rejected: item {i + 1}: unsupported cmd: {item.command}"
    if items[0].command == plan.LAND and now.landed:
        return "Mission rejected: starts with landing"
    return ""


def _gate(items: Items, _now: Situation) -> str:
    before: PlanItem | None = None
    for item in items:
        if not item.has_position and item.command != plan.CONDITION_GATE:
            continue
        if before is not None and plan.CONDITION_GATE in (item.command, before.command):
            distance = _distance(item, (before.x, before.y))
            if distance < _LEAST_GATE_DISTANCE:
                return f"Distance between waypoint and gate too close: {int(distance)} meters"
        before = item
    return ""


def _first(items: Items, now: Situation) -> str:
    item = next((item for item in items if item.has_position), None)
    if item is None or now.first_distance <= _EPSILON:
        return ""
    distance = _distance(item, now.place)
    if distance < now.first_distance:
        return ""
    return f"First waypoint too far away: {math.floor(min(distance, 2e9))}m, {int(now.first_distance)} max"


def _takeoff(items: Items, now: Situation) -> str:
    late = False
    for item in items:
        if item.command in _TAKEOFFS:
            if item.altitude(now.home_altitude) - now.home_altitude < _EPSILON:
                return "Mission rejected: Takeoff altitude below home altitude!"
            if late:
                return "Mission rejected: takeoff not first waypoint item"
        late = late or item.command not in _BEFORE_TAKEOFF
    return ""


def _vtol(items: Items, _now: Situation) -> str:
    if any(item.command in _VTOL for item in items):
        return "Mission rejected: Mission contains VTOL items but vehicle is not a VTOL"
    return ""


def _required(items: Items, now: Situation) -> str:
    takeoff = any(item.command in _TAKEOFFS for item in items)
    landing = any(item.command == plan.LAND for item in items)
    if now.required == 1 and not takeoff:
        return "Mission rejected: Takeoff waypoint required."
    if now.required == 2 and not landing:
        return "Mission rejected: Landing waypoint/pattern required."
    if now.required == 3 and not (takeoff and landing):
        return "Mission rejected: Takeoff or Landing item missing."
    if now.required == 4 and takeoff != landing:
        what = "Add Landing item or remove Takeoff" if takeoff else "Add Takeoff item or remove Landing"
        return f"Mission rejected: {what}."
    return ""


def _fence(items: Items, now: Situation) -> str:
    for i, item in enumerate(items):
        if item.has_position and not now.fence_allows(item.x, item.y, item.altitude(now.home_altitude)):
            return f"Geofence violation for waypoint {i + 1}"
    return ""


_CHECKS = (_gate, _first, _takeoff, _vtol, _required, _fence)


def check(items: Items, now: Situation, say: Say) -> bool:
    """Return whether the mission ``items`` can be flown; ``say`` is told what speaks against it."""
    if not items:
        return False
    invalid = _invalid(items, now)
    if invalid:
        say(CRITICAL, invalid)
        return False
    for i, item in enumerate(items):
        if item.has_position and item.altitude(now.home_altitude) < now.home_altitude:
            say(CRITICAL, f"Warning: Waypoint {i + 1} below home")
    found = [text for text in (one(items, now) for one in _CHECKS) if text]
    for text in found:
        say(CRITICAL, text)
    return not found
