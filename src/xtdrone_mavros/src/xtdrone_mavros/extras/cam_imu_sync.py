"""Time stamps of the autopilot's camera triggers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from mavros_msgs.msg import CamIMUStamp

from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.relayed_messages import wrap_bits
from xtdrone_mavros.uas import Plugin, Uas


class CamImuSyncPlugin(Plugin):
    """MAVROS's cam_imu_sync."""

    name = "cam_imu_sync"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topic."""
        super().__init__(uas)
        self._stamp = uas.topic("cam_imu_sync/cam_imu_stamp", CamIMUStamp())
        self.messages = {"CAMERA_TRIGGER": Feed(self._on_trigger, self._stamp)}

    def _on_trigger(self, trigger: Any) -> None:
        message = self._stamp.message
        self.uas.stamp_us(SimpleNamespace(stamp=message.frame_stamp), trigger.time_usec)
        message.frame_seq_id = wrap_bits(trigger.seq, 32)
        self._stamp.publish(message)
