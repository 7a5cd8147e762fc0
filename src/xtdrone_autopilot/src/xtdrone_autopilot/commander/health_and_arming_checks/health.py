"""Health monitoring of estimator, links, battery and motors, summarised in flags for failsafes and arming checks."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from xtdrone_autopilot.commander.failsafe import Flags
from xtdrone_autopilot.commander.health_and_arming_checks.battery_estimate import BatteryEstimate
from xtdrone_autopilot.commander.health_and_arming_checks.failure_detector import FailureDetector
from xtdrone_autopilot.commander.manual_control import ManualControl
from xtdrone_autopilot.commander.offboard_setpoint import OffboardSetpoint
from xtdrone_autopilot.estimator.fusion import POS
from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.announcements import INFO, Announcements
from xtdrone_autopilot.navigator.navigator import Navigator
from xtdrone_autopilot.vehicle_view import VehicleView
from xtdrone_common import modes
from xtdrone_common.modes import Mode

Get = Callable[[str], float]

_SUPPLY_KEY = 894281  # CBRK_SUPPLY_CHK: disables the battery checks
_NEVER_US = -(1 << 60)
# factor on the limit of an accepted horizontal error before the position becomes invalid again
_ERROR_HYSTERESIS = 2.5


class Health:
    """Health monitoring of one vehicle.

    Attributes:
        battery: battery estimate.
        detector: detector of attitude and motor failures.
        flags: flags of the last evaluation.
        breach: description of the current geofence breach, empty for none.
    """

    def __init__(
        self,
        view: VehicleView,
        get: Get,
        navigator: Navigator,
        offboard: OffboardSetpoint,
        manual: ManualControl,
        announcements: Announcements,
    ) -> None:
        """Start with all links lost.

        Args:
            view: access to the vehicle's autopilot records.
            get: returns a parameter by name.
            navigator: source of home position, mission and geofence state.
            offboard: OFFBOARD setpoint stream.
            manual: manual control input.
            announcements: receives messages for the operator.
        """
        self._view = view
        self._get = get
        self._navigator = navigator
        self._offboard = offboard
        self._manual = manual
        self._announcements = announcements
        self.battery = BatteryEstimate(get)
        self.detector = FailureDetector(view, get)
        self.breach = ""
        # every update reads these
        self._variances = np.diagonal(view.estimator["P"])[POS : POS + 2]
        self._voltage, self._current = view.cell("sensors", "battery_voltage"), view.cell("sensors", "battery_current")
        self._thrust = view.cell("control", "sp_thrust")
        # time of the last valid estimate
        self._position_us = self._relaxed_position_us = self._global_us = self._altitude_us = _NEVER_US
        self._accurate = False
        self._gcs_us: int | None = None
        self._gcs_lost = True
        self._manual_us: int | None = None
        self._manual_lost = True
        self._offboard_failed = False
        self._in_mission = False  # in flight, the navigator handles a removed mission
        self._warning = 0
        self._takeoff_us: int | None = None
        self.flags = Flags()

    def gcs_heartbeat(self) -> None:
        """Record a heartbeat from a ground station."""
        if self._gcs_lost and self._gcs_us is not None:
            self._announcements.tell(INFO, "GCS connection regained", "commander_dl_regained")
        self._gcs_us = self._view.time_us
        self._gcs_lost = False

    def update(self, mode: Mode, flown: Mode, armed: bool) -> Flags:
        """Update the battery, failure detector, links and timers, and return the flags; call at 10 Hz.

        Args:
            mode: requested mode.
            flown: active mode.
            armed: whether the vehicle is armed.
        """
        view = self._view
        now_us = view.time_us
        voltage = self._voltage[0] if int(self._get("BAT1_SOURCE")) == 0 else 0.0
        self.battery.update(now_us, voltage, self._current[0], self._thrust[0], armed)
        warning = self.battery.warning if self.battery.connected else 0
        self._warning = max(warning, self._warning) if armed else warning  # in flight the level never improves
        self.detector.update(now_us, flown.attitude_control, armed)
        self._update_gcs_link(now_us)
        self._update_manual_link(now_us)
        self.breach = self._navigator.geofence_breach()
        if not armed or view.landed:
            self._takeoff_us = None
        elif self._takeoff_us is None:
            self._takeoff_us = now_us
        self._in_mission = armed and flown is modes.AUTO_MISSION
        flags = self.evaluate(mode, armed)
        self._offboard_failed = armed and mode is modes.OFFBOARD and flags.offboard_lost
        return flags

    def evaluate(self, mode: Mode, armed: bool) -> Flags:
        """Return the current flags for the requested mode ``mode``."""
        view, get = self._view, self._get
        now_us = view.time_us
        delay_us = get("COM_POS_FS_DELAY") * 1e6 if armed else 0.0
        relaxed_position_invalid, position_invalid, altitude_invalid = self._positions(now_us, delay_us)
        limit = get("COM_OF_LOSS_T")
        longest = get("COM_FLT_TIME_MAX")
        check_battery = int(get("CBRK_SUPPLY_CHK")) != _SUPPLY_KEY
        flags = (  # values of ``Flags`` in the order of its fields; a new ``Flags`` is created only if one has changed
            not view.initialised,
            altitude_invalid,
            position_invalid,
            relaxed_position_invalid,
            position_invalid or self._global_invalid(now_us, delay_us),
            self._navigator.home is None,
            not self._in_mission and bool(self._navigator.mission_denial()),
            self._offboard_lost(limit, relaxed_position_invalid),
            self._manual_lost,
            self._gcs_lost,
            bool(self.breach),
            self._warning if check_battery else 0,
            check_battery and not self.battery.connected,
            self.detector.attitude,
            bool(self.detector.motors),
            longest > 0 and self._takeoff_us is not None and now_us - self._takeoff_us > longest * 1e6,
        )
        if flags != self.flags:
            self.flags = Flags(*flags)
        return self.flags

    def _positions(self, now_us: int, delay_us: float) -> tuple[bool, bool, bool]:
        """Return whether horizontal estimate, accurate position and altitude were each invalid for ``delay_us``."""
        relaxed_good, altitude_good = self._view.horizontal_valid, self._view.height_valid
        limit = self._get("COM_POS_FS_EPH")
        widest = limit * (_ERROR_HYSTERESIS if self._accurate else 1.0)
        self._accurate = relaxed_good and (limit <= 0.0 or self._horizontal_error() <= widest)
        if relaxed_good:
            self._relaxed_position_us = now_us
        if self._accurate:
            self._position_us = now_us
        if altitude_good:
            self._altitude_us = now_us
        return (
            not relaxed_good and now_us - self._relaxed_position_us >= delay_us,
            not self._accurate and now_us - self._position_us >= delay_us,
            not altitude_good and now_us - self._altitude_us >= delay_us,
        )

    def _global_invalid(self, now_us: int, delay_us: float) -> bool:
        """Return whether the global position was invalid for ``delay_us`` (estimatorCheck, setModeRequirementFlags)."""
        if self._view.global_valid:
            self._global_us = now_us
            return False
        return now_us - self._global_us >= delay_us

    def _horizontal_error(self) -> float:
        north, east = self._variances.tolist()
        return math.sqrt(max(north + east, 0.0))

    def _offboard_lost(self, limit: float, relaxed_position_invalid: bool) -> bool:
        """Return whether the OFFBOARD setpoint stream is missing or unusable.

        After a loss in flight the stream is accepted again once two setpoints have arrived in time, but not after the
        failsafe has landed the vehicle.
        """
        if not self._offboard.fresh(limit) or (self._offboard.needs_position and relaxed_position_invalid):
            return True
        return self._offboard_failed and (self._view.landed or not self._offboard.steady(limit))

    def _update_gcs_link(self, now_us: int) -> None:
        if self._gcs_lost or self._gcs_us is None:
            return
        if now_us - self._gcs_us > self._get("COM_DL_LOSS_T") * 1e6:
            self._gcs_lost = True
            self._announcements.tell(
                INFO, "Connection to ground station lost", "commander_gcs_lost", level=events.WARNING
            )

    def _update_manual_link(self, now_us: int) -> None:
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
