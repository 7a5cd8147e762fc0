"""Images reported by a MAVLink camera."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import CameraImageCaptured

from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas


class CameraPlugin(Plugin):
    """MAVROS's camera; as there, the orientation keeps MAVLink's frames."""

    name = "camera"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topic."""
        super().__init__(uas)
        self._captured = uas.topic("camera/image_captured", CameraImageCaptured())
        self.messages = {"CAMERA_IMAGE_CAPTURED": Feed(self._on_captured, self._captured, any_sender=True)}

    def _on_captured(self, captured: Any) -> None:
        message = self._captured.message
        self.uas.stamp(message.header, captured.time_boot_ms)
        geo, q = message.geo, message.orientation
        geo.latitude, geo.longitude = captured.lat / 1e7, captured.lon / 1e7
        geo.altitude = captured.alt / 1e3 + self.uas.geoid_height(geo.latitude, geo.longitude)
        q.w, q.x, q.y, q.z = captured.q
        message.relative_alt = captured.relative_alt / 1e3
        message.image_index = captured.image_index
        message.capture_result = captured.capture_result
        message.file_url = captured.file_url.rstrip("\0")
        self._captured.publish(message)
