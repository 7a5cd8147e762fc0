"""Flight logs of the autopilot over MAVLink's log protocol: requests as services, data as topics."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import LogData, LogEntry
from mavros_msgs.srv import (
    LogRequestData,
    LogRequestDataResponse,
    LogRequestEnd,
    LogRequestEndResponse,
    LogRequestList,
    LogRequestListResponse,
)
from pymavlink.dialects.v20 import common as mavlink
from rospy import Time
from std_srvs.srv import Trigger, TriggerResponse

from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas


class LogTransferPlugin(Plugin):
    """MAVROS's log_transfer. ``success`` means that the request was sent."""

    name = "log_transfer"

    def __init__(self, uas: Uas) -> None:
        """Advertise topics and services."""
        super().__init__(uas)
        self._entry = uas.topic("log_transfer/raw/log_entry", LogEntry())
        self._data = uas.topic("log_transfer/raw/log_data", LogData())
        # The autopilot sends these only on request. A program that subscribes and sends a request immediately must not
        # miss them until the next check for subscribers.
        self.messages = {
            "LOG_ENTRY": Feed(self._on_entry, always=True),
            "LOG_DATA": Feed(self._on_data, always=True),
        }
        uas.service("log_transfer/raw/log_request_list", LogRequestList, self._request_list)
        uas.service("log_transfer/raw/log_request_data", LogRequestData, self._request_data)
        uas.service("log_transfer/raw/log_request_end", LogRequestEnd, self._request_end)
        uas.service("log_transfer/raw/log_request_erase", Trigger, self._request_erase)

    def _on_entry(self, entry: Any) -> None:
        message = self._entry.message
        self.uas.stamp_now(message.header)
        message.id, message.num_logs, message.last_log_num = entry.id, entry.num_logs, entry.last_log_num
        message.time_utc, message.size = Time(entry.time_utc, 0), entry.size
        self._entry.publish(message)

    def _on_data(self, data: Any) -> None:
        message = self._data.message
        self.uas.stamp_now(message.header)
        message.id, message.offset = data.id, data.ofs
        message.data = bytes(data.data[: data.count])
        self._data.publish(message)

    def _request_list(self, request: Any) -> LogRequestListResponse:
        self.uas.link.send(mavlink.MAVLink_log_request_list_message(*self.uas.target, request.start, request.end))
        return LogRequestListResponse(success=True)

    def _request_data(self, request: Any) -> LogRequestDataResponse:
        wanted = request.id, request.offset, request.count
        self.uas.link.send(mavlink.MAVLink_log_request_data_message(*self.uas.target, *wanted))
        return LogRequestDataResponse(success=True)

    def _request_end(self, _request: Any) -> LogRequestEndResponse:
        self.uas.link.send(mavlink.MAVLink_log_request_end_message(*self.uas.target))
        return LogRequestEndResponse(success=True)

    def _request_erase(self, _request: Any) -> TriggerResponse:
        self.uas.link.send(mavlink.MAVLink_log_erase_message(*self.uas.target))
        return TriggerResponse(success=True)
