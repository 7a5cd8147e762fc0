"""Data for a pilot's head-up display."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import VFR_HUD

from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas


class VfrHudPlugin(Plugin):
    """MAVROS's vfr_hud; throttle is 0..1."""

    name = "vfr_hud"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topic."""
        super().__init__(uas)
        self._hud = uas.topic("vfr_hud", VFR_HUD())
        self.messages = {"VFR_HUD": Feed(self._on_hud, self._hud)}

    def _on_hud(self, hud: Any) -> None:
        message = self._hud.message
        self.uas.stamp_now(message.header)
        message.airspeed = hud.airspeed
        message.groundspeed = hud.groundspeed
        message.heading = hud.heading
        message.throttle = hud.throttle / 100.0
        message.altitude = hud.alt
        message.climb = hud.climb
        self._hud.publish(message)
