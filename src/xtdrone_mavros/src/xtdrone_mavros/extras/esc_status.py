"""Electronic speed controllers."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import ESCInfo, ESCInfoItem, ESCStatus, ESCStatusItem

from xtdrone_mavros.feeds import Feed, Topic
from xtdrone_mavros.uas import Plugin, Uas

_BATCH = 4  # ESCs in one MAVLink message
_CENTIDEGREES = 100  # per degree Celsius


class EscStatusPlugin(Plugin):
    """MAVROS's esc_status: combines MAVLink's batches of four ESCs into one message.

    Temperatures are degrees Celsius (MAVROS multiplies MAVLink's hundredths by a hundred). The number of ESCs is taken
    from ESC_INFO; ``esc_status`` is empty before the first one.
    """

    name = "esc_status"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topics."""
        super().__init__(uas)
        self._info = uas.topic("esc_info", ESCInfo())
        self._status = uas.topic("esc_status", ESCStatus())
        self._last = {"info": 0, "status": 0}  # index of the last batch
        self.messages = {
            "ESC_INFO": Feed(self._on_info, self._info, self._status),
            "ESC_STATUS": Feed(self._on_status, self._status),
        }

    def connected(self, connected: bool) -> None:
        """Drop the ESCs, because the autopilot was lost or replaced."""
        self._info.message.esc_info, self._status.message.esc_status = [], []
        self._last = {"info": 0, "status": 0}

    def _on_info(self, info: Any) -> None:
        message = self._info.message
        for name in ("counter", "count", "connection_type", "info"):
            setattr(message, name, getattr(info, name))
        items = message.esc_info
        items += [ESCInfoItem() for _ in range(info.count - len(items))]
        self.uas.stamp_us(message.header, info.time_usec)
        for i, item in enumerate(items[info.index : info.index + _BATCH]):
            self.uas.stamp_us(item.header, info.time_usec)
            item.failure_flags = info.failure_flags[i]
            item.error_count = info.error_count[i]
            item.temperature = round(info.temperature[i] / _CENTIDEGREES)
        self._publish_whole("info", info.index, self._info)

    def _on_status(self, status: Any) -> None:
        message = self._status.message
        items = message.esc_status
        items += [ESCStatusItem() for _ in range(len(self._info.message.esc_info) - len(items))]
        self.uas.stamp_us(message.header, status.time_usec)
        for i, item in enumerate(items[status.index : status.index + _BATCH]):
            self.uas.stamp_us(item.header, status.time_usec)
            item.rpm, item.voltage, item.current = status.rpm[i], status.voltage[i], status.current[i]
        self._publish_whole("status", status.index, self._status)

    def _publish_whole(self, kind: str, index: int, topic: Topic) -> None:
        """Publish after the last batch of a cycle."""
        self._last[kind] = max(self._last[kind], index)
        if index == self._last[kind] and topic.needed:
            topic.publish(topic.message)
