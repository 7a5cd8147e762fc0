"""The autopilot's clock: its offset, for stamps outside simulation, its status, and the time reference."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import TimesyncStatus
from pymavlink.dialects.v20 import common as mavlink
from rospy import Time
from sensor_msgs.msg import TimeReference

from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.lib.plugin_settings import ParamError
from xtdrone_mavros.uas import Plugin, Uas

_MODES = ("MAVLINK", "NONE")
_TIMESYNC = MESSAGE_ID["TIMESYNC"]
_RESTART_NS = 1_000_000_000  # an offset that differs by more than this belongs to another clock


class SysTimePlugin(Plugin):
    """MAVROS's sys_time, with time synchronisation by an exponential average.

    In simulation the autopilot's boot time is ROS time: clocks are compared only for ``timesync_status`` and the
    diagnostics, while these have subscribers, and no stamp depends on it.
    """

    name = "sys_time"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topics and start TIMESYNC; in simulation only while a plugin needs its answers.

        Outside simulation SYSTEM_TIME is sent, too.

        Raises:
            ParamError: ``time/timesync_mode`` is not supported.
        """
        super().__init__(uas)
        self._alpha = uas.params.get("time/timesync_avg_alpha", 0.6)
        rate = uas.params.get("conn/timesync_rate", 10.0)
        source = uas.params.get("time/time_ref_source", "fcu")
        self._reference = uas.topic("time_reference", TimeReference(source=source))
        self._status = uas.topic("timesync_status", TimesyncStatus())
        self._offset_ns: int | None = None
        self._stamps = not uas.ros.use_sim_time  # whether stamps need the offset
        self.messages = {"SYSTEM_TIME": Feed(self._on_system_time, self._reference)}
        mode = uas.params.get("time/timesync_mode", "MAVLINK")
        if mode not in _MODES:
            raise ParamError(f"parameter time/timesync_mode: {mode!r} is not offered, {' or '.join(_MODES)}")
        system_time_rate = uas.params.get("conn/system_time_rate", 1.0)
        if self._stamps and system_time_rate > 0.0:
            uas.timer(1.0 / system_time_rate, self._send_system_time)
        if rate > 0.0 and mode != "NONE":
            self.messages["TIMESYNC"] = Feed(self._on_timesync, self._status, always=self._stamps)
            uas.timer(1.0 / rate, self._send)

    def connected(self, connected: bool) -> None:
        """Drop the offset, because the autopilot may have restarted."""
        if connected:
            self._keep(None)

    def _keep(self, offset_ns: int | None) -> None:
        self._offset_ns = offset_ns
        if self._stamps:
            self.uas.time_offset_ns = offset_ns

    def _send(self) -> None:
        if _TIMESYNC in self.uas.link.wanted:
            self.uas.link.send(mavlink.MAVLink_timesync_message(0, self.uas.ros.now_ns()))

    def _send_system_time(self) -> None:
        """Send the time of day for an autopilot without a clock; the boot time field is the autopilot's own."""
        self.uas.link.send(mavlink.MAVLink_system_time_message(self.uas.ros.now_ns() // 1000, 0))

    def _on_timesync(self, sync: Any) -> None:
        now = self.uas.ros.now_ns()
        if sync.tc1 == 0:  # a request from the autopilot
            self.uas.link.send(mavlink.MAVLink_timesync_message(now, sync.ts1))
            return
        observed = (sync.ts1 + now) // 2 - sync.tc1  # assumes that the answer was sent halfway
        offset = self._offset_ns
        if offset is None or abs(observed - offset) > _RESTART_NS:
            offset = observed
        else:
            offset += round(self._alpha * (observed - offset))
        self._keep(offset)
        if self._status.needed:
            status = self._status.message
            self.uas.stamp_now(status.header)
            status.remote_timestamp_ns = max(sync.tc1, 0)
            status.observed_offset_ns = observed
            status.estimated_offset_ns = offset
            status.round_trip_time_ms = (now - sync.ts1) / 1e6
            self._status.publish(status)

    def _on_system_time(self, time: Any) -> None:
        if time.time_unix_usec == 0:  # no GPS time yet
            return
        message = self._reference.message
        self.uas.stamp(message.header, time.time_boot_ms)
        seconds, micros = divmod(time.time_unix_usec, 1_000_000)
        message.time_ref = Time(seconds, micros * 1000)
        self._reference.publish(message)
