"""What AUTO modes ask of the cascade: goals, speeds, and when they are reached (PX4's navigator, multirotors)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from . import modes
from .modes import Mode
from .parameters import Parameters
from .state import TASK_GOTO, TASK_IDLE, TASK_LAND
from .vehicle_view import Vector, VehicleView

_NAN = math.nan
_INFO, _CRITICAL = 6, 2  # MAV_SEVERITY

# phases of a return
_CLIMB, _RETURN, _DESCEND, _WAIT, _LAND = range(5)


@dataclass(frozen=True)
class Home:
    """Where a return goes to.

    Attributes:
        latitude: degrees.
        longitude: degrees.
        altitude: m AMSL.
        position: m, local NED.
        yaw: rad.
        time_us: when it was set.
    """

    latitude: float
    longitude: float
    altitude: float
    position: Vector
    yaw: float
    time_us: int


class Navigator:
    """The AUTO modes of one vehicle.

    Attributes:
        home: set by the commander; None until the first valid position.
        takeoff_altitude: m AMSL that a take-off was asked for; NaN for MIS_TAKEOFF_ALT over home.
        takeoff_yaw: rad, NaN keeps the heading.
        landing: the vehicle is on its way to the ground.
    """

    def __init__(self, view: VehicleView, parameters: Parameters, say: Callable[[int, str], None]) -> None:
        """Prepare; nothing is asked of the cascade until ``activate``.

        Args:
            view: the vehicle.
            parameters: its parameters.
            say: takes a MAV_SEVERITY and a text for the operator.
        """
        self._view = view
        self._parameters = parameters
        self._say = say
        self._mode: Mode | None = None
        self._goal: Vector = (0.0, 0.0, 0.0)
        self._phase = _CLIMB
        self._wait_until_us = 0
        self.home: Home | None = None
        self.takeoff_altitude = _NAN
        self.takeoff_yaw = _NAN
        self.landing = False

    def activate(self, mode: Mode) -> None:
        """Begin ``mode``, one of the AUTO modes, for an armed vehicle."""
        self._mode = mode
        self.landing = False
        for field in ("cruise_speed", "climb_speed", "descend_speed"):
            self._view.setpoint[field] = _NAN
        if mode is modes.AUTO_TAKEOFF:
            self._start_takeoff()
        elif self._view.landed:
            self._view.start_task(TASK_IDLE)  # these modes do not leave the ground
        elif mode is modes.AUTO_LAND:
            self._land(self._stopping_place())
        elif mode is modes.AUTO_RTL:
            self._start_return()
        else:
            self.hold()

    def deactivate(self) -> None:
        """Leave the AUTO modes."""
        self._mode = None
        self.landing = False

    def update(self) -> Mode | None:
        """Go on to the mode's next phase when the present one is done.

        Returns:
            The mode to go on with, when the present one has come to its end: a take-off that has reached its height
            goes on in AUTO.LOITER.
        """
        if self._mode is modes.AUTO_TAKEOFF and not self._view.landed and self._at_goal_height():
            return modes.AUTO_LOITER
        if self._mode is modes.AUTO_RTL and not self._view.landed:
            self._update_return()
        return None

    def mission_obstacle(self) -> str:
        """Return why AUTO.MISSION cannot be flown, or an empty text."""
        return "No valid mission available"

    def hold(self) -> None:
        """Stop, and stay there."""
        x, y, z = self._stopping_place()
        self._fly_to((x, y, z), _NAN)

    def reposition(self, position: Vector, yaw: float) -> None:
        """Fly to ``position`` (m, local NED) with heading ``yaw`` (rad; NaN: look where it goes)."""
        if math.isnan(yaw) and self._distance_to(position) > self._parameters.get("NAV_ACC_RAD"):
            yaw = self._bearing_to(position)
        self._fly_to(position, yaw)

    def change_altitude(self, z: float) -> None:
        """Climb or sink to ``z`` (m, local NED) over the present goal."""
        self._fly_to((self._goal[0], self._goal[1], z), _NAN)

    def set_speed(self, field: str, speed: float) -> None:
        """Set cruise_speed, climb_speed or descend_speed (m/s) until the next mode; NaN for the parameter's."""
        self._view.setpoint[field] = speed

    # goals

    def _fly_to(self, position: Vector, yaw: float) -> None:
        self._goal = position
        self._view.setpoint["goal_position"] = position
        self._view.setpoint["goal_yaw"] = yaw
        self._view.start_task(TASK_GOTO)

    def _land(self, place: Vector) -> None:
        ground = place[2] if self.home is None else self.home.position[2]
        self._goal = (place[0], place[1], ground)
        self.landing = True
        self._view.setpoint["goal_position"] = self._goal
        self._view.setpoint["goal_yaw"] = _NAN
        self._view.start_task(TASK_LAND)

    def _stopping_place(self) -> Vector:
        """Return the place where the vehicle comes to rest when it brakes now: v^2 / 2a ahead, at its height."""
        x, y, z = self._view.position
        vx, vy, _ = self._view.velocity
        ahead = 0.5 * math.hypot(vx, vy) / self._parameters.get("MPC_ACC_HOR")  # s, times v
        return x + vx * ahead, y + vy * ahead, z

    def _distance_to(self, position: Vector) -> float:
        x, y, _ = self._view.position
        return math.hypot(position[0] - x, position[1] - y)

    def _bearing_to(self, position: Vector) -> float:
        x, y, _ = self._view.position
        return math.atan2(position[1] - y, position[0] - x)

    def _at_goal_height(self) -> bool:
        return abs(self._view.position[2] - self._goal[2]) < self._parameters.get("NAV_MC_ALT_RAD")

    # take-off

    def _start_takeoff(self) -> None:
        x, y, z = self._view.position
        ground = z if self.home is None else self.home.position[2]
        least = self._parameters.get("MIS_TAKEOFF_ALT")
        wanted = self._view.origin[2] - self.takeoff_altitude
        goal = ground - least if math.isnan(wanted) else min(wanted, ground - least)
        if z < goal and not self._view.landed:
            self._say(_CRITICAL, "Already higher than takeoff altitude")
            goal = z
        elif goal != wanted:
            self._say(_INFO, f"Using minimum takeoff altitude: {least:.2f} m")
        self._fly_to((x, y, goal), self.takeoff_yaw)
        self.takeoff_altitude = self.takeoff_yaw = _NAN

    # return

    def _start_return(self) -> None:
        assert self.home is not None, "the commander checks that there is a home"
        self._say(_INFO, "RTL: landing at home position.")
        x, y, z = self._view.position
        goal = self.home.position[2] - self._return_height(self.home)
        self._phase = _CLIMB
        self._announce("climb to", min(goal, z))
        self._fly_to((x, y, min(goal, z)), _NAN)

    def _return_height(self, home: Home) -> float:
        """Return the height over home (m) at which to fly back: RTL_RETURN_ALT, lower inside the cone over home."""
        full = self._parameters.get("RTL_RETURN_ALT")
        distance = self._distance_to(home.position)
        radius = self._parameters.get("NAV_ACC_RAD")
        if distance <= radius:
            return min(2.0 * distance, full)
        cone = self._parameters.get("RTL_CONE_ANG")
        if cone <= 0 or distance > self._parameters.get("RTL_MIN_DIST"):
            return full
        inside = distance / math.tan(math.radians(min(max(cone, 1), 89)))
        return max(min(inside, full), 2.0 * radius)

    def _announce(self, what: str, z: float) -> None:
        assert self.home is not None
        height = self.home.position[2] - z
        self._say(_INFO, f"RTL: {what} {self.home.altitude + height:.0f} m ({height:.0f} m above destination)")

    def _update_return(self) -> None:
        assert self.home is not None
        home = self.home.position
        if self._phase == _CLIMB and self._at_goal_height():
            self._phase = _RETURN
            self._announce("return at", self._goal[2])
            far = self._distance_to(home) > self._parameters.get("NAV_ACC_RAD")
            self._fly_to((home[0], home[1], self._goal[2]), self._bearing_to(home) if far else _NAN)
        elif self._phase == _RETURN and self._distance_to(home) < self._parameters.get("NAV_ACC_RAD"):
            self._phase = _DESCEND
            goal = max(home[2] - self._parameters.get("RTL_DESCEND_ALT"), self._goal[2])
            self._announce("descend to", goal)
            self._fly_to((home[0], home[1], goal), _NAN)
        elif self._phase == _DESCEND and self._at_goal_height():
            self._phase = _WAIT
            delay = self._parameters.get("RTL_LAND_DELAY")
            self._wait_until_us = self._view.time_us + int(delay * 1e6)
            if delay < 0:
                self._wait_until_us = 1 << 62
        if self._phase == _WAIT and self._view.time_us >= self._wait_until_us:
            self._phase = _LAND
            self._say(_INFO, "RTL: land at destination")
            self._land(home)
