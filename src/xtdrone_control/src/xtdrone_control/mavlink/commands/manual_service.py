"""Manual control: MANUAL_CONTROL (a joystick at a ground station) and RC_CHANNELS_OVERRIDE (a radio's channels)."""

from __future__ import annotations

from typing import Any, ClassVar

from xtdrone_control.autopilot.commander.manual_control import CHANNELS
from xtdrone_control.autopilot.commander.offboard_setpoint import SetpointError
from xtdrone_control.mavlink.client_link import Link
from xtdrone_control.mavlink.service_base import Service

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
