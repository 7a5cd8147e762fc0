"""ORBIT mode: a circle around a point, entered at its nearest point (PX4 v1.14's FlightTaskOrbit)."""

from __future__ import annotations

import math
from collections.abc import Sequence

from xtdrone_autopilot import c_casts
from xtdrone_autopilot.events.announcements import CRITICAL
from xtdrone_autopilot.events.events import ERROR
from xtdrone_autopilot.flight_tasks.auto_setpoint import Course
from xtdrone_autopilot.state import ORBIT_TO_CENTRE, TASK_ORBIT
from xtdrone_autopilot.vehicle_view import Vector

LEAST_RADIUS = 1.0  # m
_LARGEST_SPEED = 10.0  # m/s
_LARGEST_ACCELERATION = 2.0  # m/s^2, towards the centre
_DEFAULT_SPEED = 1.0  # m/s
_REACHED = 0.5  # share of the radius: distance from the circle at which the approach ends


class Orbit:
    """Orbit of one vehicle.

    Attributes:
        centre: north and east, m, local NED.
        radius: m.
        speed: m/s along the circle, positive clockwise seen from above.
        yaw_behaviour: MAVLink ORBIT_YAW_BEHAVIOUR.
        circling: whether the circle has been reached.
    """

    def __init__(self, course: Course) -> None:
        """Initialise; the setpoint is not changed until ``start``."""
        self._course = course
        self.centre = (0.0, 0.0)
        self.circling = False
        self.forget()

    def forget(self) -> None:
        """Restore the defaults; the next orbit takes nothing from the last one (PX4 ``FlightTaskOrbit::activate``)."""
        self.radius = LEAST_RADIUS
        self.speed = _DEFAULT_SPEED
        self.yaw_behaviour = ORBIT_TO_CENTRE
        self._altitude = math.nan
        self._place: tuple[float, float] | None = None
        self._possible = True

    def command(self, radius: float, speed: float, yaw_behaviour: float, place: Sequence[float]) -> None:
        """Store the parameters of MAV_CMD_DO_ORBIT for ``start``; NaN keeps the value of the orbit that is flown.

        With a radius outside its limits, which is announced, the vehicle holds instead. The speed is limited to a
        centripetal acceleration of 2 m/s^2.

        Args:
            radius: m, positive clockwise; absolute value from 1 to MC_ORBIT_RAD_MAX.
            speed: m/s along the circle, up to 10; negative against the direction of ``radius``.
            yaw_behaviour: MAVLink ORBIT_YAW_BEHAVIOUR.
            place: latitude and longitude of the centre in degrees, and the altitude to fly at, m AMSL.
        """
        view = self._course.view
        clockwise = self.speed > 0.0 if math.isnan(radius) else radius > 0.0
        wanted = self.radius if math.isnan(radius) else abs(radius)
        self._possible = LEAST_RADIUS <= wanted <= self._course.parameters.get("MC_ORBIT_RAD_MAX")
        if self._possible:
            limit = min(_LARGEST_SPEED, math.sqrt(_LARGEST_ACCELERATION * wanted))
            along = min(max(abs(self.speed) if math.isnan(speed) else speed, -limit), limit)
            self.radius, self.speed = wanted, along if clockwise else -along
        else:
            text = "Orbit radius limit exceeded"
            self._course.announcements.tell(CRITICAL, text, "orbit_radius_exceeded", level=ERROR)
        if math.isfinite(yaw_behaviour):
            self.yaw_behaviour = c_casts.to_byte(yaw_behaviour)
        if view.has_origin and math.isfinite(place[0]) and math.isfinite(place[1]):
            north, east, _ = view.to_local(place[0], place[1], 0.0)
            self._place = (north, east)
        if math.isfinite(place[2]):
            self._altitude = place[2]

    def start(self) -> None:
        """Fly to the nearest point on the circle, heading towards it."""
        self.circling = False
        if not self._possible:
            self._course.hold()
            return
        view = self._course.view
        x, y, z = self._course.stopping_place()
        if self._place is None:
            self._place = (x - self.radius, y)
        self.centre = self._place
        if math.isfinite(self._altitude) and view.has_origin:
            z = view.origin[2] - self._altitude
        setpoint = view.setpoint
        setpoint["orbit_centre"] = self.centre
        setpoint["orbit_radius"] = self.radius
        setpoint["orbit_speed"] = self.speed
        setpoint["orbit_yaw"] = self.yaw_behaviour
        setpoint["orbit_heading"] = view.yaw
        goal = self._nearest(z)
        self._course.fly_to(goal, self._course.bearing_to(goal), speed=self._course.parameters.get("MPC_XY_CRUISE"))

    def update(self) -> None:
        """Start circling once the circle is reached; call at 10 Hz."""
        if self.circling or not self._possible:
            return
        near = min(self._course.parameters.get("NAV_ACC_RAD"), _REACHED * self.radius)
        if self._course.distance_to(self._course.goal) < near and self._course.at_height(self._course.goal[2]):
            self.circling = True
            self._course.view.start_task(TASK_ORBIT)

    def _nearest(self, z: float) -> Vector:
        x, y, _ = self._course.view.position
        north, east = x - self.centre[0], y - self.centre[1]
        distance = math.hypot(north, east)
        if distance < 1e-3:
            north, distance = 1.0, 1.0
        scale = self.radius / distance
        return self.centre[0] + north * scale, self.centre[1] + east * scale, z
