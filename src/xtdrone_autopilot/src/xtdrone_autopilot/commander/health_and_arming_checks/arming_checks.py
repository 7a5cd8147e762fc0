"""Health and arming checks, modelled on PX4 v1.14: the modes that allow arming and the reasons against it.

Each failing check is reported as the corresponding PX4 event, which a ground station shows with its own text. Summary
events list the failing components and the available modes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

from xtdrone_autopilot.commander.failsafe import BATTERY_CRITICAL, BATTERY_EMERGENCY, BATTERY_LOW, Flags, can_run
from xtdrone_autopilot.events import events
from xtdrone_autopilot.events.event_catalogue import CATALOGUE
from xtdrone_autopilot.events.events import Event, event
from xtdrone_autopilot.vehicle_view import VehicleView
from xtdrone_common import modes
from xtdrone_common.modes import Mode

Get = Callable[[str], float]

_ALL_MODES = 0xFFFFFFFF
_STICKS_DISABLED = 4  # COM_RC_IN_MODE
_REPORT_INTERVAL_US = 2_000_000
_SMOOTHING = 0.05  # of the innovation test ratios, at 10 Hz
_MAX_RATIO = 1e4  # larger or non-finite ratios result from invalid parameters
_FIX_3D = 3


class Check(NamedTuple):
    """Failing check.

    Attributes:
        name: name of PX4's event.
        level: log level, for example ``events.ERROR``.
        component: bit number of PX4's health_component_t.
        modes: bit mask of the navigation states in which the check prevents arming; 0 for a mere warning.
    """

    name: str
    level: int
    component: int
    modes: int

    @property
    def text(self) -> str:
        """Message of the event."""
        return CATALOGUE[self.name].message


@dataclass(frozen=True)
class Report:
    """Result of the checks.

    Attributes:
        failures: failing checks.
        can_arm: bit mask of the navigation states that allow arming.
        can_run: bit mask of the navigation states that can be flown.
    """

    failures: tuple[Check, ...]
    can_arm: int
    can_run: int

    def allows(self, mode: Mode) -> bool:
        """Return whether arming is possible in ``mode``."""
        return bool(self.can_arm >> mode.state & 1)

    def reason(self, mode: Mode) -> str:
        """Return the reason why the vehicle cannot be armed in ``mode``, or an empty string."""
        return next((check.text for check in self.failures if check.modes >> mode.state & 1), "")

    def component_bits(self, *, warnings: bool) -> int:
        """Return the bit mask of components (health_component_t) with a warning, or of those with an error."""
        bits = 0
        for check in self.failures:
            if warnings is (check.level > events.ERROR) and check.level <= events.WARNING:
                bits |= 1 << check.component
        return bits


def _mask(chosen: Iterable[Mode]) -> int:
    bits = 0
    for mode in chosen:
        bits |= 1 << mode.state
    return bits


def _needing(need: str) -> int:
    return _mask(mode for mode in modes.ALL if need in mode.needs)


_NEEDS = ("attitude", "altitude", "position", "global_position", "home", "mission", "offboard")
_BY_NEED = {need: _needing(need) for need in _NEEDS}
_POSITIONED = _BY_NEED["position"] | _needing("relaxed_position")
_BY_STICKS = _mask(mode for mode in modes.ALL if mode.sticks)
_UNARMABLE = _mask(mode for mode in modes.ALL if mode.prevents_arming)


@lru_cache(maxsize=256)
def _flyable(flags: Flags) -> int:
    """Return the bit mask of the modes that can be flown."""
    return _mask(mode for mode in modes.ALL if can_run(mode, flags) and not (mode.sticks and flags.manual_lost))


def _mode_checks(flags: Flags, get: Get) -> list[Check]:
    """Return the unmet needs of the modes, as PX4's ModeChecks does."""
    found = []
    if flags.attitude_invalid:
        found.append(Check("check_modes_attitude", events.CRITICAL, events.ATTITUDE_ESTIMATE, _BY_NEED["attitude"]))
    if flags.position_invalid:
        found.append(
            Check(
                "check_modes_local_pos",
                events.ERROR,
                events.LOCAL_POSITION,
                _POSITIONED if flags.relaxed_position_invalid else _BY_NEED["position"],
            )
        )
    if flags.global_position_invalid:
        found.append(Check("check_modes_global_pos", events.ERROR, events.SYSTEM, _BY_NEED["global_position"]))
    if flags.altitude_invalid:
        found.append(Check("check_modes_local_alt", events.CRITICAL, events.SYSTEM, _BY_NEED["altitude"]))
    if flags.mission_missing:
        concerned = _ALL_MODES if int(get("COM_ARM_MIS_REQ")) else _BY_NEED["mission"]
        found.append(Check("check_modes_mission", events.INFO, events.SYSTEM, concerned))
    if flags.offboard_lost:
        found.append(Check("check_modes_offboard_signal", events.ERROR, events.SYSTEM, _BY_NEED["offboard"]))
    if flags.home_missing:
        found.append(Check("check_modes_home_position", events.INFO, events.SYSTEM, _BY_NEED["home"]))
    if flags.manual_lost:
        level = events.ERROR if int(get("COM_RC_IN_MODE")) == _STICKS_DISABLED else events.WARNING
        found.append(Check("check_modes_manual_control", level, events.REMOTE_CONTROL, _BY_STICKS))
    return found


def _battery_checks(flags: Flags) -> list[Check]:
    if flags.battery_unhealthy:
        return [Check("check_battery_unhealthy", events.ERROR, events.BATTERY, _ALL_MODES)]
    name, level, concerned = {
        BATTERY_LOW: ("check_battery_low", events.WARNING, 0),
        BATTERY_CRITICAL: ("check_battery_critical", events.CRITICAL, _ALL_MODES),
        BATTERY_EMERGENCY: ("check_battery_emergency", events.EMERGENCY, _ALL_MODES),
    }.get(flags.battery, ("", events.INFO, 0))
    return [Check(name, level, events.BATTERY, concerned)] if name else []


def _link_checks(flags: Flags, get: Get) -> list[Check]:
    if not flags.gcs_lost:
        return []
    needed = int(get("NAV_DLL_ACT")) > 0
    return [
        Check(
            "check_rc_dl_no_dllink", events.ERROR if needed else events.INFO, events.LINKS, _ALL_MODES if needed else 0
        )
    ]


def _failure_checks(flags: Flags) -> list[Check]:
    found = []
    if flags.attitude_failure:
        found.append(Check("check_failure_detector_attitude", events.CRITICAL, events.ATTITUDE_ESTIMATE, _ALL_MODES))
    if flags.motor_failure:
        found.append(Check("check_failure_detector_motor", events.CRITICAL, events.MOTORS, _ALL_MODES))
    if flags.geofence:
        found.append(Check("check_gf_violation", events.ERROR, events.SYSTEM, _ALL_MODES))
    return found


def _root(ratio: float) -> float:
    return math.sqrt(min(ratio, _MAX_RATIO)) if ratio > 0.0 else 0.0


class ArmingChecks:
    """Arming checks of one vehicle and their reporting."""

    def __init__(self, view: VehicleView, get: Get) -> None:
        """Start with nothing reported.

        Args:
            view: access to the vehicle's autopilot records.
            get: returns a parameter by name.
        """
        self._view = view
        self._get = get
        self._ratios = [0.0, 0.0, 0.0, 0.0]
        self._reported: tuple[tuple[Check, ...], int, int] | None = None
        self._reported_us = -_REPORT_INTERVAL_US

    def follow_innovations(self) -> None:
        """Filter the innovation test ratios; call at 10 Hz while the vehicle is disarmed.

        The limits apply to the ratio of innovation and gate, of which the estimator's test ratios are the squares. The
        ratios are low-pass filtered, because with well-known noise a single ordinary innovation comes close to a limit.
        """
        test_ratio = self._view.estimator["test_ratio"]
        for index, field in enumerate(("vel", "pos", "hgt", "mag")):
            self._ratios[index] += _SMOOTHING * (_root(float(test_ratio[field])) - self._ratios[index])

    def report(self, flags: Flags, mode: Mode, armed: bool) -> Report:
        """Run the checks.

        Args:
            flags: health flags.
            mode: requested mode.
            armed: whether the vehicle is already armed.
        """
        found = []
        if not armed and mode.prevents_arming:
            found.append(Check("check_modes_cannot_takeoff", events.INFO, events.SYSTEM, _UNARMABLE))
        found += _mode_checks(flags, self._get)
        if not armed:
            found += self._estimator_checks()
        found += _battery_checks(flags) + _link_checks(flags, self._get) + _failure_checks(flags)
        can_arm = _ALL_MODES & ~_UNARMABLE
        for check in found:
            can_arm &= ~check.modes
        return Report(tuple(found), can_arm, _flyable(flags))

    def _estimator_checks(self) -> list[Check]:
        get = self._get
        found = []
        for ratio, limit, name, component in zip(
            self._ratios,
            ("COM_ARM_EKF_VEL", "COM_ARM_EKF_POS", "COM_ARM_EKF_HGT", "COM_ARM_EKF_YAW"),
            ("vel", "pos", "hgt", "heading"),
            (events.LOCAL_POSITION, events.LOCAL_POSITION, events.LOCAL_POSITION, events.ATTITUDE_ESTIMATE),
            strict=True,
        ):
            if ratio > get(limit):
                found.append(Check(f"check_estimator_{name}_not_stable", events.ERROR, component, _BY_NEED["position"]))
        if self._view.sensors["gps_fix"] < _FIX_3D:
            needed = not int(get("COM_ARM_WO_GPS"))
            found.append(
                Check(
                    "check_estimator_gps_fix_too_low",
                    events.ERROR if needed else events.WARNING,
                    events.GPS,
                    _ALL_MODES if needed else 0,
                )
            )
        return found

    def events(self, report: Report, now_us: int, *, force: bool = False) -> list[Event]:
        """Return the events for ``report`` when it differs from the last one reported.

        Args:
            report: result of the checks.
            now_us: simulated time, microseconds.
            force: return the events in any case, for example after a rejected request to arm.
        """
        key = (report.failures, report.can_arm, report.can_run)
        if not force and (key == self._reported or now_us - self._reported_us < _REPORT_INTERVAL_US):
            return []
        self._reported, self._reported_us = key, now_us
        failing = report.component_bits(warnings=False), report.component_bits(warnings=True)
        possible = report.can_arm, report.can_run
        summary = event("commander_arming_check_summary", events.PROTOCOL, now_us, 0, *failing, *possible)
        details = [
            event(check.name, check.level, now_us, check.modes or _ALL_MODES, check.component)
            for check in report.failures
        ]
        present = 1 << events.GPS | 1 << events.BATTERY | 1 << events.MOTORS | 1 << events.ATTITUDE_ESTIMATE
        health = event("commander_health_summary", events.PROTOCOL, now_us, 0, present, 0, 0)
        return [summary, *details, health]
