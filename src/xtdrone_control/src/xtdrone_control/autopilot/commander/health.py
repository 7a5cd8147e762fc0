"""What is wrong with a vehicle: looks at estimator, links, battery and motors, and sums it up in flags."""

from __future__ import annotations

import math
from collections.abc import Callable

from xtdrone_control.autopilot import modes
from xtdrone_control.autopilot.commander.battery import BatteryEstimate
from xtdrone_control.autopilot.commander.failsafe import Flags
from xtdrone_control.autopilot.commander.failure_detector import FailureDetector
from xtdrone_control.autopilot.commander.inputs import OffboardInput
from xtdrone_control.autopilot.commander.manual_control import ManualControl
from xtdrone_control.autopilot.events import events
from xtdrone_control.autopilot.events.announcements import INFO, Announcements
from xtdrone_control.autopilot.modes import Mode
from xtdrone_control.autopilot.navigator.navigator import Navigator
from xtdrone_control.autopilot.vehicle_view import VehicleView

Get = Callable[[str], float]

_SUPPLY_KEY = 894281  # CBRK_SUPPLY_CHK: the battery is not looked at
_NEVER_US = -(1 << 60)
# a horizontal error that has been small enough may grow that much before it is too large
_ERROR_HYSTERESIS = 2.5


class Health:
    """The state of health of one vehicle.

    Attributes:
        battery: what is known of the battery.
        detector: attitude limit and motors.
        flags: what was wrong at the last ``update``.
        breach: the geofence that is breached, empty for none.
    """

    def __init__(
        self,
        view: VehicleView,
        get: Get,
        navigator: Navigator,
        offboard: OffboardInput,
        manual: ManualControl,
        announcements: Announcements,
    ) -> None:
        """Look at the given parts of one vehicle; ``get`` returns a parameter by name."""
        self._view = view
        self._get = get
        self._navigator = navigator
        self._offboard = offboard
        self._manual = manual
        self._announcements = announcements
        self.battery = BatteryEstimate(get)
        self.detector = FailureDetector(view, get)
        self.breach = ""
        self._covariance = view.estimator["P"]
        self._position_us = self._place_us = self._altitude_us = _NEVER_US  # when each was last good
        self._exact = False
        self._gcs_us: int | None = None
        self._gcs_lost = True
        self._manual_us: int | None = None
        self._manual_lost = True
        self._offboard_failed = False
        self._in_mission = False  # the navigator ends a mission that is taken away in flight
        self._warning = 0
        self._takeoff_us: int | None = None
        self.flags = Flags()

    def gcs_heartbeat(self) -> None:
        """Note that a ground station is there."""
        if self._gcs_lost and self._gcs_us is not None:
            self._announcements.tell(INFO, "GCS connection regained", "commander_dl_regained")
        self._gcs_us = self._view.time_us
        self._gcs_lost = False

    def update(self, mode: Mode, flown: Mode, armed: bool) -> Flags:
        """Look at everything that takes time; call it at 10 Hz.

        Args:
            mode: the mode that was asked for.
            flown: the mode that is flown.
            armed: whether motors run.
        """
        view = self._view
        now_us = view.time_us
        sensors, thrust = view.sensors, float(view.control["sp_thrust"])
        self.battery.update(now_us, float(sensors["battery_voltage"]), float(sensors["battery_current"]), thrust, armed)
        warning = self.battery.warning if self.battery.connected else 0
        self._warning = max(warning, self._warning) if armed else warning  # in flight it never gets better
        self.detector.update(now_us, flown.attitude_control, armed)
        self._watch_gcs(now_us)
        self._watch_manual(now_us)
        self.breach = self._navigator.geofence_breach()
        if not armed or view.landed:
            self._takeoff_us = None
        elif self._takeoff_us is None:
            self._takeoff_us = now_us
        self._in_mission = armed and flown is modes.AUTO_MISSION
        flags = self.look(mode, armed)
        self._offboard_failed = armed and mode is modes.OFFBOARD and flags.offboard_lost
        return flags

    def look(self, mode: Mode, armed: bool) -> Flags:
        """Return what is wrong now, when ``mode`` was asked for."""
        view, get = self._view, self._get
        now_us = view.time_us
        delay_us = get("COM_POS_FS_DELAY") * 1e6 if armed else 0.0
        place_invalid, position_invalid, altitude_invalid = self._positions(now_us, delay_us)
        limit = get("COM_OF_LOSS_T")
        longest = get("COM_FLT_TIME_MAX")
        look_at_battery = int(get("CBRK_SUPPLY_CHK")) != _SUPPLY_KEY
        self.flags = Flags(
            attitude_invalid=not view.initialised,
            altitude_invalid=altitude_invalid,
            position_invalid=position_invalid,
            place_invalid=place_invalid,
            home_missing=self._navigator.home is None,
            mission_missing=not self._in_mission and bool(self._navigator.mission_obstacle()),
            offboard_lost=self._offboard_lost(limit, place_invalid),
            manual_lost=self._manual_lost,
            gcs_lost=self._gcs_lost,
            geofence=bool(self.breach),
            battery=self._warning if look_at_battery else 0,
            battery_unhealthy=look_at_battery and not self.battery.connected,
            attitude_failure=self.detector.attitude,
            motor_failure=bool(self.detector.motors),
            flight_time_exceeded=(
                longest > 0 and self._takeoff_us is not None and now_us - self._takeoff_us > longest * 1e6
            ),
        )
        return self.flags

    def _positions(self, now_us: int, delay_us: float) -> tuple[bool, bool, bool]:
        """Return whether place, exact position and height have been bad for longer than COM_POS_FS_DELAY."""
        e = self._view.estimator
        place_good, altitude_good = bool(e["position_valid"]), bool(e["altitude_valid"])
        limit = self._get("COM_POS_FS_EPH")
        widest = limit * (_ERROR_HYSTERESIS if self._exact else 1.0)
        self._exact = place_good and (limit <= 0.0 or self._horizontal_error() <= widest)
        if place_good:
            self._place_us = now_us
        if self._exact:
            self._position_us = now_us
        if altitude_good:
            self._altitude_us = now_us
        return (
            not place_good and now_us - self._place_us >= delay_us,
            not self._exact and now_us - self._position_us >= delay_us,
            not altitude_good and now_us - self._altitude_us >= delay_us,
        )

    def _horizontal_error(self) -> float:
        covariance = self._covariance
        return math.sqrt(max(float(covariance[6, 6] + covariance[7, 7]), 0.0))

    def _offboard_lost(self, limit: float, place_invalid: bool) -> bool:
        """Return whether OFFBOARD has nothing to follow.

        A stream that has failed in flight counts again when two setpoints have come in time, and not on the ground,
        where a failsafe has put the vehicle.
        """
        if not self._offboard.fresh(limit) or (self._offboard.needs_position and place_invalid):
            return True
        return self._offboard_failed and (self._view.landed or not self._offboard.steady(limit))

    def _watch_gcs(self, now_us: int) -> None:
        if self._gcs_lost or self._gcs_us is None:
            return
        if now_us - self._gcs_us > self._get("COM_DL_LOSS_T") * 1e6:
            self._gcs_lost = True
            self._announcements.tell(
                INFO, "Connection to ground station lost", "commander_gcs_lost", level=events.WARNING
            )

    def _watch_manual(self, now_us: int) -> None:
        lost = self._manual.sticks is None
        if lost and not self._manual_lost:
            self._announcements.tell(INFO, "Manual control lost", "commander_rc_lost")
        elif not lost and self._manual_lost and self._manual_us is not None:
            elapsed = (now_us - self._manual_us) * 1e-6
            self._announcements.tell(
                INFO, f"Manual control regained after {elapsed:.1f} s", "commander_rc_regained", elapsed
            )
        self._manual_lost = lost
        if not lost:
            self._manual_us = now_us
