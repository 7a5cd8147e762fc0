"""Goals of the AUTO modes: write them to the setpoint, and measure the vehicle's position relative to them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from xtdrone_autopilot.events.announcements import Announcements
from xtdrone_autopilot.parameters.parameters import Parameters
from xtdrone_autopilot.state import TASK_GOTO, TASK_LAND
from xtdrone_autopilot.vehicle_view import Vector, VehicleView

NAN = math.nan
UNSET: Vector = (NAN, NAN, NAN)
STILL = (0.0, 0.0)  # m/s, velocity of a goal
INFO, CRITICAL = 6, 2  # MAV_SEVERITY

# MPC_YAW_MODE
_TOWARDS_HOME, _AWAY_FROM_HOME, _ALONG_TRAJECTORY = 1, 2, 3
FLT_EPSILON = 2.0**-23  # PX4's
_BRAKING_DELAY = 0.6  # s
_LEAST_SPEED = 0.3  # m/s, minimum velocity that defines a heading
_LEAST_BRAKING = 2.0  # m/s^2, minimum of PX4's MPC_ACC_*; parameters may be out of range


def braking_time(speed: float, deceleration: float) -> float:
    """Return the time (s) to brake from ``speed`` (m/s) at ``deceleration`` (m/s^2, at least 2)."""
    return speed / max(deceleration, _LEAST_BRAKING)


@dataclass(frozen=True)
class Home:
    """A home position.

    Attributes:
        latitude: degrees.
        longitude: degrees.
        altitude: m AMSL.
        position: m, local NED.
        yaw: rad.
        time_us: simulated time of its setting, microseconds.
        manual: whether a command gave the position; it does not follow the vehicle then.
    """

    latitude: float
    longitude: float
    altitude: float
    position: Vector
    yaw: float
    time_us: int
    manual: bool = False


class Course:
    """The goals of one vehicle's AUTO modes.

    Attributes:
        view: the vehicle.
        parameters: its parameters.
        announcements: texts and events for the operator.
        home: None until the first valid position.
        cruising_speed: horizontal speed of this and later goals, m/s; NaN for MPC_XY_CRUISE.
        goal: m, local NED.
        landing: whether the current goal is a landing.
        taking_off: whether the current goal is the end of a takeoff.
    """

    def __init__(self, view: VehicleView, parameters: Parameters, announcements: Announcements) -> None:
        """Initialise without a goal; the setpoint is not changed."""
        self.view = view
        self.parameters = parameters
        self.announcements = announcements
        self.home: Home | None = None
        self.cruising_speed = NAN
        self.goal: Vector = (0.0, 0.0, 0.0)
        self.landing = False
        self.taking_off = False
        self._heading_free = False

    # goals

    def fly_to(
        self, position: Vector, yaw: float = NAN, *, onward: Vector = UNSET, radius: float = NAN, speed: float = NAN
    ) -> None:
        """Fly to ``position``.

        Args:
            position: m, local NED.
            yaw: rad; NaN keeps the heading, see also ``free_heading``.
            onward: next goal, reached without a stop at ``position``, m, local NED; NaN to stop.
            radius: acceptance radius of ``position``, m; NaN for NAV_ACC_RAD.
            speed: horizontal speed to this goal alone, m/s; NaN for ``cruising_speed``.
        """
        self.goal = position
        self.landing = self.taking_off = False
        self._heading_free = False
        setpoint = self.view.setpoint
        setpoint["goal_position"] = position
        setpoint["goal_velocity"] = STILL
        setpoint["goal_yaw"] = yaw
        setpoint["onward_position"] = onward
        setpoint["goal_radius"] = radius
        setpoint["cruise_speed"] = self.cruising_speed if math.isnan(speed) else speed
        self.view.start_task(TASK_GOTO)

    def set_cruising_speed(self, speed: float, *, at_once: bool) -> None:
        """Set the horizontal speed (m/s) of later goals, and of this one if ``at_once``.

        A speed that is not positive, or NaN, restores MPC_XY_CRUISE.
        """
        self.cruising_speed = speed if speed > FLT_EPSILON else NAN
        if at_once:
            self.view.setpoint["cruise_speed"] = self.cruising_speed

    def lead_onward(self, onward: Vector) -> None:
        """Set the goal after the current one: passed through without a stop there, or NaN to stop; m, local NED."""
        self.view.setpoint["onward_position"] = onward

    def take_off(self, position: Vector, yaw: float) -> None:
        """Climb to ``position`` (m, local NED) at MPC_TKO_SPEED, with heading ``yaw`` (rad, NaN keeps it)."""
        self.view.setpoint["climb_speed"] = self.parameters.get("MPC_TKO_SPEED")
        self.fly_to(position, yaw)
        self.taking_off = True

    def land(self, place: Vector) -> None:
        """Land at ``place`` (m, local NED); the ground is assumed at home's height, or at ``place`` without a home."""
        ground = place[2] if self.home is None else self.home.position[2]
        self.goal = (place[0], place[1], ground)
        self.landing = True
        self.taking_off = self._heading_free = False
        setpoint = self.view.setpoint
        setpoint["goal_position"] = self.goal
        setpoint["goal_velocity"] = STILL
        setpoint["goal_yaw"] = NAN
        setpoint["onward_position"] = UNSET
        setpoint["cruise_speed"] = self.cruising_speed
        self.view.start_task(TASK_LAND)

    def hold(self) -> None:
        """Brake and hold the position reached."""
        self.fly_to(self.stopping_place())

    def shift(self, north: float, east: float, velocity: tuple[float, float] = STILL) -> None:
        """Move the current goal horizontally to ``north``, ``east`` (m, local), where it has a velocity (m/s)."""
        self.goal = (north, east, self.goal[2])
        self.view.setpoint["goal_position"] = self.goal
        self.view.setpoint["goal_velocity"] = velocity

    def look(self, yaw: float) -> None:
        """Set the heading ``yaw`` (rad) for the flight to the current goal."""
        self.view.setpoint["goal_yaw"] = yaw

    def free_heading(self) -> None:
        """Set the heading by MPC_YAW_MODE during the flight to the current goal."""
        self._heading_free = True
        self.update_heading()

    def update_heading(self) -> None:
        """Update the heading by MPC_YAW_MODE; within the goal's acceptance radius keep it."""
        given = float(self.view.setpoint["goal_radius"])
        radius = self.parameters.get("NAV_ACC_RAD") if math.isnan(given) else given
        if not self._heading_free or self.distance_to(self.goal) <= radius:
            return
        mode = self.parameters.get("MPC_YAW_MODE")
        if mode in (_TOWARDS_HOME, _AWAY_FROM_HOME) and self.home is not None:
            if self.distance_to(self.home.position) > radius:
                towards = self.bearing_to(self.home.position)
                self.look(towards if mode == _TOWARDS_HOME else towards + math.pi)
            return
        if mode == _ALONG_TRAJECTORY:
            north, east, _ = self.view.velocity
            if math.hypot(north, east) > _LEAST_SPEED:
                self.look(math.atan2(east, north))
            return
        self.look(self.bearing_to(self.goal))

    # geometry

    def stopping_place(self) -> Vector:
        """Return the position (m, local NED) at which the vehicle comes to rest if it brakes now, at its height.

        That is v^2 / 2a ahead, plus the distance flown while the deceleration builds up (PX4
        computeBrakingDistanceFromVelocity).
        """
        x, y, z = self.view.position
        vx, vy, _ = self.view.velocity
        seconds = 0.5 * braking_time(math.hypot(vx, vy), self.parameters.get("MPC_ACC_HOR")) + _BRAKING_DELAY
        return x + vx * seconds, y + vy * seconds, z

    def distance_to(self, position: Vector) -> float:
        """Return the horizontal distance to ``position``, m."""
        x, y, _ = self.view.position
        return math.hypot(position[0] - x, position[1] - y)

    def bearing_to(self, position: Vector) -> float:
        """Return the bearing of ``position``, rad, clockwise from north."""
        x, y, _ = self.view.position
        return math.atan2(position[1] - y, position[0] - x)

    def at_height(self, z: float) -> bool:
        """Return whether the vehicle is within NAV_MC_ALT_RAD of ``z`` (m, local NED)."""
        return abs(self.view.position[2] - z) < self.parameters.get("NAV_MC_ALT_RAD")

    @property
    def ground(self) -> float:
        """Down coordinate of home, m, local NED; the vehicle's while no home is set."""
        return self.view.position[2] if self.home is None else self.home.position[2]
