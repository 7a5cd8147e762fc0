"""Setpoint messages in OFFBOARD."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.commander.commander import CRITICAL, Commander
from xtdrone_control.autopilot.commander.offboard_setpoint import SetpointError
from xtdrone_control.mavlink.client_link import Link
from xtdrone_control.mavlink.commands import setpoint_conversion
from xtdrone_control.mavlink.service_base import Service, Vehicle

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
            if self.vehicle.commander.offboard_incomplete:
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
