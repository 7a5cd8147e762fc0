"""PX4's RTL mode: climb, return, descend, loiter and land at home, a rally point or the mission landing.

The navigator flies the mission instead for RTL_TYPE 2.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from xtdrone_autopilot.flight_tasks.auto_setpoint import INFO, NAN, Course
from xtdrone_autopilot.navigator import plan
from xtdrone_autopilot.navigator.mission import Mission
from xtdrone_autopilot.navigator.precision_landing import PrecisionLanding
from xtdrone_autopilot.vehicle_view import Vector

# RTL_TYPE
_MISSION_LANDING, MISSION_REVERSED, _CLOSEST = 1, 2, 3
BY_MISSION = (_MISSION_LANDING, MISSION_REVERSED, _CLOSEST)
_HOME_HEADING, _SAME_HEADING = 1, 2  # RTL_HDG_MD
_AT_MISSION = "rtl_land_at_mission"
_NEVER_US = 1 << 62


class _Phase(enum.Enum):
    CLIMB = enum.auto()
    RETURN = enum.auto()
    DESCEND = enum.auto()
    WAIT = enum.auto()
    LAND = enum.auto()


@dataclass(frozen=True)
class _Destination:
    """Landing position, m, local NED, with its name in texts and the event that announces it."""

    position: Vector
    name: str
    event: str


class Return:
    """Return flight of one vehicle."""

    def __init__(self, course: Course, mission: Mission, landing: PrecisionLanding) -> None:
        """Prepare an inactive return.

        Args:
            course: goals of the vehicle.
            mission: source of the mission landing and the rally points.
            landing: precision landing for RTL_PLD_MD.
        """
        self._course = course
        self._get = course.parameters.get
        self._tell = course.announcements.tell
        self._mission = mission
        self._landing = landing
        self._phase = _Phase.CLIMB
        self._to = _Destination((0.0, 0.0, 0.0), "", "")
        self._until_us = 0

    def start(self) -> None:
        """Start the return at the current position; requires a home position."""
        self._to = self._choose()
        self._tell(INFO, f"RTL: landing at {self._to.name}.", self._to.event)
        if self._to.event == _AT_MISSION and self._mission.landing_in_progress:
            self._land()
            return
        x, y, z = self._course.view.position
        height = min(self._to.position[2] - self._height(), z)
        self._phase = _Phase.CLIMB
        self._announce("climb to", "rtl_climb_to", height)
        self._course.fly_to((x, y, height), self._home_heading())

    def update(self) -> None:
        """Advance to the next phase when the current one is complete; call at 10 Hz in flight."""
        to = self._to.position
        goal = self._course.goal[2]
        if self._phase is _Phase.CLIMB and self._course.at_height(goal):
            self._phase = _Phase.RETURN
            self._announce("return at", "rtl_return_at", goal)
            self._course.fly_to((to[0], to[1], goal), self._home_heading())
            if self._get("RTL_HDG_MD") not in (_HOME_HEADING, _SAME_HEADING):
                self._course.free_heading()
        elif self._phase is _Phase.RETURN and self._course.distance_to(to) < self._get("NAV_ACC_RAD"):
            self._phase = _Phase.DESCEND
            height = max(to[2] - self._get("RTL_DESCEND_ALT"), goal)
            self._announce("descend to", "rtl_descend_to", height)
            self._course.fly_to((to[0], to[1], height), self._home_heading())
        elif self._phase is _Phase.DESCEND and self._course.at_height(goal):
            self._wait()
        if self._phase is _Phase.WAIT and self._course.view.time_us >= self._until_us:
            self._land()
        if self._phase is _Phase.LAND and self._landing.active:
            self._landing.update()
        self._course.update_heading()

    def _wait(self) -> None:
        self._phase = _Phase.WAIT
        delay = self._get("RTL_LAND_DELAY")
        self._until_us = _NEVER_US if delay < 0.0 else self._course.view.time_us + int(delay * 1e6)
        if delay < 0.0:
            self._tell(INFO, "RTL: completed, loitering", "rtl_completed_loiter")
        elif delay > 0.0:
            self._tell(INFO, f"RTL: loiter {delay:.1f}s", "rtl_loiter", delay)

    def _land(self) -> None:
        self._phase = _Phase.LAND
        self._tell(INFO, "RTL: land at destination", "rtl_land_at_destination")
        precise = int(self._get("RTL_PLD_MD"))
        if precise in (1, 2):
            self._landing.start(self._to.position, precise)
        else:
            self._course.land(self._to.position)
            self._course.look(self._home_heading())

    def _home_heading(self) -> float:
        """Return the heading at home for RTL_HDG_MD 1, else NaN, which keeps the current one."""
        home = self._course.home
        return home.yaw if home is not None and self._get("RTL_HDG_MD") == _HOME_HEADING else NAN

    def _choose(self) -> _Destination:
        """Return the destination selected by RTL_TYPE (PX4 ``RTL::find_RTL_destination``)."""
        home = self._course.home
        assert home is not None, "the commander checks for a home position"
        kind = self._get("RTL_TYPE")
        best = _Destination(home.position, "home position", "rtl_land_at_home")
        landing = self._mission.landing_item()
        if landing is not None and kind in (_MISSION_LANDING, MISSION_REVERSED, _CLOSEST):
            candidate = _Destination(self._local(landing[0], home.altitude), "mission landing", _AT_MISSION)
            if kind != _CLOSEST or self._distance(candidate) < self._distance(best):
                best = candidate
        if kind == MISSION_REVERSED:
            return best
        for item in self._mission.plans.items[plan.RALLY]:
            if item.command != plan.RALLY_POINT or not all(map(math.isfinite, (item.x, item.y, item.z))):
                continue
            candidate = _Destination(self._local(item, home.altitude), "safe landing point", "rtl_land_at_safe_point")
            if self._distance(candidate) < self._distance(best):
                best = candidate
        return best

    def _local(self, item: plan.PlanItem, home_altitude: float) -> Vector:
        return self._course.view.to_local(item.x, item.y, item.altitude(home_altitude))

    def _distance(self, to: _Destination) -> float:
        return self._course.distance_to(to.position)

    def _height(self) -> float:
        """Return the return height above the destination, m: RTL_RETURN_ALT, or less inside the cone above it."""
        full = self._get("RTL_RETURN_ALT")
        distance = self._distance(self._to)
        radius = self._get("NAV_ACC_RAD")
        if distance <= radius:
            return float(min(2.0 * distance, full))
        cone = self._get("RTL_CONE_ANG")
        if cone <= 0 or distance > self._get("RTL_MIN_DIST"):
            return float(full)
        inside = distance / math.tan(math.radians(min(max(cone, 1), 89)))
        return float(max(min(inside, full), 2.0 * radius))

    def _announce(self, phase: str, name: str, z: float) -> None:
        over = self._to.position[2] - z
        altitude = self._course.view.origin[2] - z
        text = f"RTL: {phase} {altitude:.0f} m ({over:.0f} m above destination)"
        self._tell(INFO, text, name, round(altitude), round(over))
