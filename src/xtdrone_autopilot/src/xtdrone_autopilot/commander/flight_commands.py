"""Flight commands: takeoff, landing, return, reposition, home position and others (PX4's ``handle_command``)."""

from __future__ import annotations

import enum
import math
from typing import Protocol

from xtdrone_autopilot.commander.home_position import HomePosition
from xtdrone_autopilot.commander.motors import ArmReason
from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.announcements import CRITICAL, INFO, Announcements
from xtdrone_autopilot.navigator.navigator import Goal, Navigator
from xtdrone_autopilot.vehicle_view import Vector, VehicleView
from xtdrone_common import modes
from xtdrone_common.geodesy import projection
from xtdrone_common.modes import Mode


class Result(enum.IntEnum):
    """MAV_RESULT of a command's acknowledgement."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5


class CommandedVehicle(Protocol):
    """What flight commands need of the commander; see ``commander.Commander``."""

    view: VehicleView
    navigator: Navigator
    armed: bool

    @property
    def mode(self) -> Mode:
        """Active mode."""

    def request(self, mode: Mode) -> Result:
        """Switch to a mode if possible."""

    def arm(self, reason: ArmReason) -> bool:
        """Arm if the checks allow it; return whether the vehicle is armed."""


class FlightCommands:
    """Flight commands of one vehicle, implemented as mode changes."""

    def __init__(self, commander: CommandedVehicle, home: HomePosition, announcements: Announcements) -> None:
        """Command the vehicle of ``commander``."""
        self._commander = commander
        self._view, self._navigator = commander.view, commander.navigator
        self._home = home
        self._announcements = announcements

    def takeoff(self, altitude: float, yaw: float, place: tuple[float, float] = (math.nan, math.nan)) -> Result:
        """Take off in AUTO.TAKEOFF; the values apply to the next takeoff only.

        Args:
            altitude: m AMSL; NaN for MIS_TAKEOFF_ALT above home.
            yaw: rad, also in MAV_CMD_NAV_TAKEOFF, whose degrees PX4 v1.14 does not convert; NaN keeps the heading.
            place: latitude and longitude of the end of the climb, degrees; NaN for the vehicle's.
        """
        given = [value for value in place if not math.isnan(value)]
        if math.isinf(altitude) or math.isinf(yaw) or (len(given) > 1 and not projection.is_place(*place, 0.0)):
            return Result.DENIED
        self._navigator.takeoff_altitude = altitude
        self._navigator.takeoff_yaw = yaw
        self._navigator.takeoff_place = place
        return self._commander.request(modes.AUTO_TAKEOFF)

    def land(self) -> Result:
        """Land in AUTO.LAND."""
        return self._go(modes.AUTO_LAND, "Landing at current position", "commander_landing_current_pos")

    def precision_land(self) -> Result:
        """Land on the landing target in AUTO.PRECLAND."""
        return self._go(modes.AUTO_PRECLAND, "Precision landing", "commander_landing_prec_land")

    def return_to_launch(self) -> Result:
        """Return in AUTO.RTL."""
        return self._go(modes.AUTO_RTL, "Returning to launch", "commander_rtl")

    def start_mission(self, first: float) -> Result:
        """Arm and fly the mission.

        Args:
            first: index of the item to start with; -1 for the current one.
        """
        if self._navigator.mission_denial():
            text = "Mission start denied! No valid mission"
            self._announcements.tell(CRITICAL, text, "commander_mission_start_denied_no_mission")
            return Result.DENIED
        if not -1.0 <= first < len(self._navigator.plans.mission):
            return Result.DENIED
        if first >= 0.0:
            self._navigator.set_current(int(first))
        if self._commander.request(modes.AUTO_MISSION) is Result.ACCEPTED and self._commander.arm(ArmReason.MISSION):
            return Result.ACCEPTED
        self._announcements.mode_refused(modes.AUTO_MISSION)
        return Result.TEMPORARILY_REJECTED

    def _go(self, mode: Mode, text: str, name: str) -> Result:
        result = self._commander.request(mode)
        if result is Result.ACCEPTED:
            self._announcements.tell(INFO, text, name)
        return result

    def set_home(self, location: Vector | None, yaw: float | None = None) -> Result:
        """Set the home position.

        Args:
            location: latitude and longitude in degrees, altitude in m AMSL; None for the vehicle's position.
            yaw: rad, NaN if unknown; None for the vehicle's heading.
        """
        if not self._home.enabled or (location is not None and not projection.is_place(*location)):
            return Result.DENIED
        if location is None:
            done = self._home.set_here(force=True)
        else:
            done = self._home.set_manually(location, self._view.yaw if yaw is None else yaw)
        return Result.ACCEPTED if done else Result.TEMPORARILY_REJECTED

    def reposition(self, location: Vector, yaw: float, speed: float) -> Result:
        """Fly to a position in AUTO.LOITER (PX4's commander switches, its navigator takes the position).

        Without a position and a heading the vehicle brakes and holds; without a position alone it keeps its goal's.
        A disarmed vehicle only changes its mode; from the ground an armed one takes off to a higher position.

        Args:
            location: latitude and longitude in degrees, altitude in m AMSL; NaN keeps the current value.
            yaw: rad; NaN turns towards a goal beyond NAV_ACC_RAD.
            speed: m/s to this position alone; NaN, 0 or less for that of ``change_speed``, or MPC_XY_CRUISE.
        """
        known = [0.0 if math.isnan(value) else value for value in location]
        if not projection.is_place(*known) or math.isinf(yaw) or math.isinf(speed):
            return Result.DENIED
        goal = self._navigator.goal_before_a_pause()
        if not self._hold_to_fly():
            return Result.TEMPORARILY_REJECTED
        if (
            self._commander.armed and self._commander.mode is modes.AUTO_LOITER
        ):  # otherwise disarmed, or a failsafe overrides the mode
            self._fly_to(location, yaw, speed, goal)
        return Result.ACCEPTED

    def _hold_to_fly(self) -> bool:
        """Switch to AUTO.LOITER for a goal in global coordinates; return whether that was possible."""
        if self._commander.armed and not self._view.has_origin:
            self._announcements.mode_refused(modes.AUTO_LOITER)
            return False
        return self._commander.request(modes.AUTO_LOITER) is Result.ACCEPTED

    def _fly_to(self, location: Vector, yaw: float, speed: float, goal: Goal) -> None:
        latitude, longitude, altitude = location
        has_place = not math.isnan(latitude) and not math.isnan(longitude)
        z = self._view.position[2] if math.isnan(altitude) else self._view.origin[2] - altitude
        if not has_place and math.isnan(altitude) and math.isnan(yaw):
            self._navigator.pause(goal)
            return
        position = (*(self._view.to_local(latitude, longitude, 0.0)[:2] if has_place else goal.place), z)
        if has_place and self._navigator.geofence_forbids(position):  # PX4 accepts the command before this check
            text = "Reposition is outside geofence"
            self._announcements.tell(CRITICAL, text, "navigator_reposition_outside_geofence", level=events.ERROR)
            return
        self._navigator.reposition(position, yaw, speed if speed > 0.0 else math.nan)

    def orbit(self, radius: float, speed: float, yaw_behaviour: float, location: Vector) -> Result:
        """Fly a circle in ORBIT; see :meth:`.orbit.Orbit.command` for the arguments."""
        if any(math.isinf(value) for value in (radius, speed, yaw_behaviour, *location)):
            return Result.DENIED
        if self._commander.mode is not modes.ORBIT:
            self._navigator.orbit.forget()
        self._navigator.orbit.command(radius, speed, yaw_behaviour, location)
        result = self._commander.request(modes.ORBIT)
        if result is not Result.ACCEPTED:
            self._announcements.say(CRITICAL, "Orbit command rejected")
        return result

    def change_altitude(self, altitude: float) -> Result:
        """Climb or descend to ``altitude`` (m AMSL, NaN: the vehicle's) in AUTO.LOITER, where the vehicle brakes.

        PX4 v1.14 does not look at the frame in param2 of MAV_CMD_DO_CHANGE_ALTITUDE.
        """
        if math.isinf(altitude):
            return Result.DENIED
        goal = self._navigator.goal_before_a_pause()
        if not self._hold_to_fly():
            return Result.TEMPORARILY_REJECTED
        if self._commander.armed and self._commander.mode is modes.AUTO_LOITER:
            self._navigator.pause(goal, self._view.origin[2] - altitude)
        return Result.ACCEPTED

    def change_speed(self, kind: float, speed: float) -> Result:
        """Set the horizontal speed of AUTO modes, see ``Navigator.change_speed``; PX4 accepts any values."""
        self._navigator.change_speed(kind, speed)
        return Result.ACCEPTED
