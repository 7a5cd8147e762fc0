"""Altitudes above several references."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import Altitude

from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas


class AltitudePlugin(Plugin):
    """MAVROS's altitude."""

    name = "altitude"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topic."""
        super().__init__(uas)
        self._altitude = uas.topic("altitude", Altitude())
        self._altitude.message.header.frame_id = uas.params.get("altitude/frame_id", "map")
        self.messages = {"ALTITUDE": Feed(self._on_altitude, self._altitude)}

    def _on_altitude(self, altitude: Any) -> None:
        message = self._altitude.message
        self.uas.stamp_us(message.header, altitude.time_usec)
        message.monotonic = altitude.altitude_monotonic
        message.amsl = altitude.altitude_amsl
        message.local = altitude.altitude_local
        message.relative = altitude.altitude_relative
        message.terrain = altitude.altitude_terrain
        message.bottom_clearance = altitude.bottom_clearance
        self._altitude.publish(message)
