"""Messages that steer the vehicle: setpoints in OFFBOARD, joystick and radio, reports of the target to follow."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.commander import CRITICAL, Commander
from xtdrone_autopilot.commander.manual_control import CHANNELS
from xtdrone_autopilot.commander.offboard_setpoint import SetpointError
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.commands import setpoint_conversion
from xtdrone_autopilot.mavlink.service_base import Service, Vehicle

_TEXT_INTERVAL_US = 1_000_000


class SetpointService(Service):
    """Passes setpoints to the commander."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "SET_POSITION_TARGET_LOCAL_NED": "_local_target",
        "SET_POSITION_TARGET_GLOBAL_INT": "_global_target",
        "SET_ATTITUDE_TARGET": "_attitude_target",
    }
    CAPABILITIES = (
        mavlink.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
    )

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._next_text_us = 0

    def _local_target(self, link: Link, m: Any) -> None:
        self._queue(link, setpoint_conversion.local_target, m)

    def _global_target(self, link: Link, m: Any) -> None:
        self._queue(link, setpoint_conversion.global_target, m)

    def _attitude_target(self, link: Link, m: Any) -> None:
        self._queue(link, setpoint_conversion.attitude_target, m)

    def _queue(self, link: Link, apply: Callable[[Commander, Any], None], m: Any) -> None:
        self.vehicle.call_or_queue(lambda: self._apply_setpoint(link, apply, m))

    def _apply_setpoint(self, link: Link, apply: Callable[[Commander, Any], None], m: Any) -> None:
        try:
            apply(self.vehicle.commander, m)
            if self.vehicle.commander.offboard.incomplete:
                text = "setpoint cannot be flown: an axis has no finite value; the vehicle stops and waits"
                link.warn("setpoint that cannot be flown", text, self.vehicle.now_us)
        except SetpointError as error:
            if isinstance(error, setpoint_conversion.RefusedSetpointError):
                self._send_text(str(error))
            link.warn("setpoint", f"setpoint rejected: {error}", self.vehicle.now_us)

    def _send_text(self, text: str) -> None:
        """Send ``text`` to the operators, at most one text in a simulated second."""
        if self.vehicle.now_us >= self._next_text_us:
            self._next_text_us = self.vehicle.now_us + _TEXT_INTERVAL_US
            self.vehicle.commander.say(CRITICAL, text)


class FollowService(Service):
    """Passes target reports to the navigator.

    As in PX4 v1.14, latitude, longitude, altitude and velocity are used regardless of ``est_capabilities``, which
    MAVSDK leaves without the bit of the velocity. The time of a report is its arrival; the timestamp, taken from the
    sender's clock, is ignored.
    """

    MESSAGES: ClassVar[dict[str, str]] = {"FOLLOW_TARGET": "_target"}

    def _target(self, link: Link, m: Any) -> None:
        self.vehicle.call_or_queue(lambda: self._report_target(link, m))

    def _report_target(self, link: Link, m: Any) -> None:
        north, east, down = m.vel
        position = (m.lat * 1e-7, m.lon * 1e-7, m.alt)
        try:
            self.vehicle.commander.navigator.follow_target.report(position, (north, east, down))
        except ValueError as error:
            link.warn("target", f"FOLLOW_TARGET rejected: {error}", self.vehicle.now_us)


_RANGE = 1000.0
_UNUSED = 0x7FFF  # INT16_MAX: axis not used


class ManualService(Service):
    """Passes sticks and radio channels to the commander; held like setpoints, see ``receiver``."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "MANUAL_CONTROL": "_manual_control",
        "RC_CHANNELS_OVERRIDE": "_rc_channels_override",
    }

    def _manual_control(self, link: Link, m: Any) -> None:
        """Convert x, y, r in -1000..1000 and z in 0..1000, 500 in the middle, to -1..1, as PX4 does."""
        x, y, yaw = (0.0 if value == _UNUSED else value / _RANGE for value in (m.x, m.y, m.r))
        z = 0.0 if m.z == _UNUSED else 2.0 * m.z / _RANGE - 1.0
        self.vehicle.call_or_queue(lambda: self._apply_sticks(link, x, y, z, yaw))

    def _apply_sticks(self, link: Link, x: float, y: float, z: float, yaw: float) -> None:
        try:
            self.vehicle.commander.manual_control(x, y, z, yaw)
        except SetpointError as error:
            link.warn("manual", f"sticks rejected: {error}", self.vehicle.now_us)

    def _rc_channels_override(self, _link: Link, m: Any) -> None:
        channels = [getattr(m, f"chan{number}_raw") for number in range(1, CHANNELS + 1)]
        self.vehicle.call_or_queue(lambda: self.vehicle.commander.radio_control(channels))
