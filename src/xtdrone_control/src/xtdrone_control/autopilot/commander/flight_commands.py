"""Flight commands: takeoff, landing, return, reposition, home position and others (PX4's ``handle_command``)."""

from __future__ import annotations

import enum
import math
from abc import ABC, abstractmethod

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.commander.motors import ArmReason
from xtdrone_control.autopilot.events import events
from xtdrone_control.autopilot.events.announcements import CRITICAL, INFO, Announcements
from xtdrone_control.autopilot.modes import Mode
from xtdrone_control.autopilot.navigator.navigator import Home, Navigator
from xtdrone_control.autopilot.vehicle_view import Vector, VehicleView
from xtdrone_control.geodesy import projection


class Result(enum.IntEnum):
    """MAV_RESULT of a command's acknowledgement."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5


class FlightCommands(ABC):
    """Flight commands of one vehicle, implemented as mode changes.

    Attributes:
        view: access to the vehicle's autopilot records.
        navigator: AUTO modes.
        armed: whether the vehicle is armed.
    """

    view: VehicleView
    navigator: Navigator
    armed: bool
    _announcements: Announcements

    @property
    @abstractmethod
    def mode(self) -> Mode:
        """Active mode."""

    @abstractmethod
    def request(self, mode: Mode) -> Result:
        """Switch to a mode if possible."""

    @abstractmethod
    def _arm(self, reason: ArmReason, force: bool = False) -> bool:
        """Arm if the checks allow it; return whether the vehicle is armed."""

    @property
    def home(self) -> Home | None:
        """Home position, None until it is set."""
        return self.navigator.home

    def takeoff(self, altitude: float, yaw: float) -> Result:
        """Take off in AUTO.TAKEOFF.

        Args:
            altitude: m AMSL; NaN for MIS_TAKEOFF_ALT above home.
            yaw: rad; NaN keeps the heading.
        """
        if math.isinf(altitude) or math.isinf(yaw):
            return Result.DENIED
        self.navigator.takeoff_altitude = altitude
        self.navigator.takeoff_yaw = yaw
        return self.request(modes.AUTO_TAKEOFF)

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
        if self.navigator.mission_denial():
            text = "Mission start denied! No valid mission"
            self._announcements.tell(CRITICAL, text, "commander_mission_start_denied_no_mission")
            return Result.DENIED
        if not -1.0 <= first < len(self.navigator.plans.mission):
            return Result.DENIED
        if first >= 0.0:
            self.navigator.set_current(int(first))
        if self.request(modes.AUTO_MISSION) is Result.ACCEPTED and self._arm(ArmReason.MISSION):
            return Result.ACCEPTED
        self._announcements.mode_refused(modes.AUTO_MISSION)
        return Result.TEMPORARILY_REJECTED

    def _go(self, mode: Mode, text: str, name: str) -> Result:
        result = self.request(mode)
        if result is Result.ACCEPTED:
            self._announcements.tell(INFO, text, name)
        return result

    def set_home(self, location: Vector | None) -> Result:
        """Set the home position to (latitude, longitude, altitude), degrees and m AMSL, or to the vehicle's (None)."""
        if location is None:
            if not self.view.global_valid:
                return Result.TEMPORARILY_REJECTED
            self._set_home_here()
            return Result.ACCEPTED
        if not projection.is_place(*location):
            return Result.DENIED
        if not self.view.global_valid:
            return Result.TEMPORARILY_REJECTED
        position = self.view.to_local(*location)
        self.navigator.home = Home(*location, position, self.view.yaw, self.view.time_us)
        return Result.ACCEPTED

    def _set_home_here(self) -> None:
        position = self.view.position
        location = self.view.to_global(position)
        self.navigator.home = Home(*location, position, self.view.yaw, self.view.time_us)

    def reposition(self, location: Vector, yaw: float, speed: float) -> Result:
        """Fly to a position in AUTO.LOITER.

        Args:
            location: latitude and longitude in degrees, altitude in m AMSL; NaN keeps the current value.
            yaw: rad; NaN turns towards a goal beyond NAV_ACC_RAD.
            speed: m/s; NaN, 0 or less for MPC_XY_CRUISE.
        """
        here = self.view.to_global(self.view.position)
        target = tuple(h if math.isnan(p) else p for p, h in zip(location, here, strict=True))
        if not projection.is_place(*target) or math.isinf(yaw) or math.isinf(speed):
            return Result.DENIED
        able = self.armed and not self.view.landed and self.view.has_origin
        if not able or self.request(modes.AUTO_LOITER) is not Result.ACCEPTED:
            self._announcements.tell(CRITICAL, "Reposition command rejected", "commander_reposition_rejected")
            return Result.TEMPORARILY_REJECTED
        if self.mode is not modes.AUTO_LOITER:
            return Result.ACCEPTED  # a failsafe overrides the mode
        position = self.view.to_local(*target)
        if self.navigator.geofence_forbids(position):  # PX4 accepts the command before this check
            text = "Reposition is outside geofence"
            self._announcements.tell(CRITICAL, text, "navigator_reposition_outside_geofence", level=events.ERROR)
            return Result.ACCEPTED
        if speed > 0.0:
            self.navigator.set_speed("cruise_speed", speed)
        self.navigator.reposition(position, yaw)
        return Result.ACCEPTED

    def orbit(self, radius: float, speed: float, yaw_behaviour: float, location: Vector) -> Result:
        """Fly a circle in ORBIT; see :meth:`.orbit.Orbit.command` for the arguments."""
        if any(math.isinf(value) for value in (radius, speed, yaw_behaviour, *location)):
            return Result.DENIED
        self.navigator.orbit.command(radius, speed, yaw_behaviour, location)
        result = self.request(modes.ORBIT)
        if result is not Result.ACCEPTED:
            self._announcements.say(CRITICAL, "Orbit command rejected")
        return result

    def change_altitude(self, altitude: float) -> Result:
        """Climb or descend to ``altitude`` (m AMSL) in AUTO.LOITER."""
        if not math.isfinite(altitude):
            return Result.DENIED
        if not self.view.has_origin or self.request(modes.AUTO_LOITER) is not Result.ACCEPTED:
            return Result.TEMPORARILY_REJECTED
        if self.armed and not self.view.landed and self.mode is modes.AUTO_LOITER:
            self.navigator.change_altitude(self.view.origin[2] - altitude)
        return Result.ACCEPTED

    def change_speed(self, kind: int, speed: float) -> Result:
        """Set the speed of AUTO modes until the next mode.

        Args:
            kind: SPEED_TYPE: 0 and 1 horizontal, 2 climb, 3 descent.
            speed: m/s; -1 keeps the current speed, 0 and other negative values restore the parameter's.
        """
        field = {0: "cruise_speed", 1: "cruise_speed", 2: "climb_speed", 3: "descend_speed"}.get(kind)
        if field is None or not math.isfinite(speed):
            return Result.DENIED
        if speed != -1.0:
            self.navigator.set_speed(field, speed if speed > 0.0 else math.nan)
        return Result.ACCEPTED
