"""/diagnostics: state of link, heartbeat, sensors, battery, GPS and clocks, as in MAVROS's diagnostic updater.

Names, keys, levels and texts are those of MAVROS 1.x (mavlink_diag.cpp, sys_status.cpp, global_position.cpp,
sys_time.cpp). Frames are counted only while /diagnostics has a subscriber, to save the cost for every vehicle.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common.modes import mode_name
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.lib.plugin_settings import ParamError, Params, PluginLists
from xtdrone_mavros.plugins.sys_status import cell_voltages
from xtdrone_mavros.uas import RAW, Plugin, Uas

_OK, _WARN, _ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
_PERIOD = 1.0  # s of ROS time
_NS = 1_000_000_000
_WINDOW = 10  # reports over which a frequency is measured
_TOLERANCE = 0.1
_LEAST_SATELLITE_FIX = 2
_UNKNOWN = 65535
_MOST_BATTERIES = 10
_DEFAULT_MIN_VOLTAGE = 10.0  # V


class Report(NamedTuple):
    """One status: its level, its summary, and its keys and values."""

    level: int
    summary: str
    values: list[tuple[str, str]]


class Frequency:
    """Frequency of an event, over the last reports."""

    def __init__(self, least: float, most: float) -> None:
        """Set the normal range in Hz."""
        self.count = 0
        self._least, self._most = least * (1.0 - _TOLERANCE), most * (1.0 + _TOLERANCE)
        self._history: deque[tuple[int, int]] = deque([(0, 0)], _WINDOW)

    def restart(self, now_ns: int) -> None:
        """Restart the measurement."""
        self._history.clear()
        self._history.append((now_ns, self.count))

    def report(self, now_ns: int) -> tuple[int, str, float]:
        """Return level, summary and frequency (Hz) since the report ``_WINDOW`` ago."""
        since_ns, before = self._history[0]
        events = self.count - before
        frequency = events * _NS / (now_ns - since_ns) if now_ns > since_ns else 0.0
        self._history.append((now_ns, self.count))
        if events == 0:
            return _ERROR, "No events recorded.", frequency
        if frequency < self._least:
            return _WARN, "Frequency too low.", frequency
        if frequency > self._most:
            return _WARN, "Frequency too high.", frequency
        return _OK, "Normal", frequency


class DiagnosticsPlugin(Plugin):
    """MAVROS's diagnostics: one message per vehicle and second while /diagnostics has a subscriber.

    Statuses that belong to a plugin that is not loaded are omitted.
    """

    name = "diagnostics"
    listed = False

    def __init__(self, uas: Uas) -> None:
        """Advertise the topic."""
        super().__init__(uas)
        loads = PluginLists(uas.params).loads
        self._topic = topic = uas.topic("/diagnostics", DiagnosticArray())
        self._link = _LinkCounts()
        self._heartbeats = Frequency(0.2, 100.0)
        self._syncs = Frequency(0.1, 10.0)
        self._counting = False
        self._heartbeat: Any = None
        self._round_trip_ns = self._round_trips_ns = self._remote_ns = 0
        self._batteries: dict[int, Any] = {}
        self._min_voltages = _min_voltages(uas.params)
        self._reports: list[tuple[str, Callable[[], Report]]] = [("FCU connection", self._report_link)]
        self.messages = {RAW: Feed(self._link.count, topic)}
        if loads("global_position"):
            self._reports.append(("GPS", self._report_gps))
            self.messages["GPS_RAW_INT"] = Feed(None, topic)
        if loads("sys_status"):
            self._reports.append(("Heartbeat", self._report_heartbeat))
            self.messages["HEARTBEAT"] = Feed(self._on_heartbeat, always=True)
            if not uas.params.get("sys/disable_diag", False):
                self._add_system(topic)
        compares = (
            uas.params.get("conn/timesync_rate", 10.0) > 0.0 and uas.params.get("time/timesync_mode", "") != "NONE"
        )
        if loads("sys_time") and compares:  # sys_time sends the requests while a feed needs the answers
            self._reports.append(("Time Sync", self._report_time))
            self.messages["TIMESYNC"] = Feed(self._on_timesync, topic, always=not uas.ros.use_sim_time)
        uas.timer(_PERIOD, self._publish)

    def connected(self, connected: bool) -> None:
        """Drop the batteries, because the autopilot may have been replaced."""
        self._batteries.clear()

    def _add_system(self, topic: Any) -> None:
        self._reports.append(("System", self._report_system))
        self.messages["SYS_STATUS"] = Feed(None, topic)
        self.messages["BATTERY_STATUS"] = Feed(self._on_battery, topic)
        for number in range(len(self._min_voltages)):
            title = f"Battery {number + 1}" if number else "Battery"
            self._reports.append((title, lambda number=number: self._report_battery(number)))  # type: ignore[misc]

    def _publish(self) -> None:
        if not self._topic.needed:
            self._counting = False
            self._link.pause()
            return
        if not self._counting:  # the counters have just started
            self._counting = True
            self._link.restart(self.uas)
            self._heartbeats.restart(self.uas.now_ns)
            self._syncs.restart(self.uas.now_ns)
            return
        message = self._topic.message
        self.uas.stamp_now(message.header)
        message.status = [self._status(title, report()) for title, report in self._reports]
        self._topic.publish(message)

    def _status(self, title: str, report: Report) -> DiagnosticStatus:
        link = self.uas.link
        host, port = link.remote
        return DiagnosticStatus(
            report.level,
            f"{self.uas.prefix[1:]}: {title}",
            report.summary,
            f"udp://:{link.port}@{host}:{port}",
            [KeyValue(key, value) for key, value in report.values],
        )

    # Input

    def _on_heartbeat(self, heartbeat: Any) -> None:
        self._heartbeat = heartbeat
        self._heartbeats.count += 1

    def _on_battery(self, battery: Any) -> None:
        self._batteries[battery.id] = battery

    def _on_timesync(self, sync: Any) -> None:
        if sync.tc1 != 0:
            self._syncs.count += 1
            self._round_trip_ns = self.uas.ros.now_ns() - sync.ts1
            self._round_trips_ns += self._round_trip_ns
            self._remote_ns = sync.tc1

    # Output

    def _report_link(self) -> Report:
        return self._link.report(self.uas)

    def _report_heartbeat(self) -> Report:
        level, summary, frequency = self._heartbeats.report(self.uas.now_ns)
        beat = self._heartbeat
        kind, autopilot, state = (beat.type, beat.autopilot, beat.system_status) if beat else (0, 0, 0)
        return Report(
            level,
            summary,
            [
                ("Heartbeats since startup", str(self._heartbeats.count)),
                ("Frequency (Hz)", f"{frequency:f}"),
                ("Vehicle type", _describe("MAV_TYPE", kind)),
                ("Autopilot type", _describe("MAV_AUTOPILOT", autopilot)),
                ("Mode", mode_name(beat.base_mode, beat.custom_mode) if beat else ""),
                ("System status", mavlink.enums["MAV_STATE"][state].name[len("MAV_STATE_") :].capitalize()),
            ],
        )

    def _report_gps(self) -> Report:
        gps = self.uas.latest("GPS_RAW_INT")
        satellites, fix = (gps.satellites_visible, gps.fix_type) if gps else (0, 0)
        if satellites == 0:
            level, summary = _ERROR, "No satellites"
        elif fix < _LEAST_SATELLITE_FIX:
            level, summary = _WARN, "No fix"
        else:
            level, summary = _OK, "2D fix" if fix == _LEAST_SATELLITE_FIX else "3D fix"
        eph, epv = (_precision(gps.eph), _precision(gps.epv)) if gps else ("Unknown", "Unknown")
        values = [("Satellites visible", str(satellites)), ("Fix type", str(fix)), ("EPH (m)", eph), ("EPV (m)", epv)]
        return Report(level, summary, values)

    def _report_system(self) -> Report:
        status = self.uas.latest("SYS_STATUS")
        present, enabled, healthy = (
            (
                status.onboard_control_sensors_present,
                status.onboard_control_sensors_enabled,
                status.onboard_control_sensors_health,
            )
            if status
            else (0, 0, 0)
        )
        values = [("Sensor present", present), ("Sensor enabled", enabled), ("Sensor health", healthy)]
        told = [(key, f"0x{value:08X}") for key, value in values]
        told += [(name, "Ok" if healthy & bit else "Fail") for bit, name in _SENSORS if enabled & bit]
        told += [
            ("CPU Load (%)", f"{(status.load if status else 0) / 10.0:.1f}"),
            ("Drop rate (%)", f"{(status.drop_rate_comm if status else 0) / 10.0:.1f}"),
            ("Errors comm", str(status.errors_comm if status else 0)),
        ]
        told += [
            (f"Errors count #{number}", str(getattr(status, f"errors_count{number}", 0))) for number in range(1, 5)
        ]
        if healthy & enabled != enabled:
            return Report(_ERROR, "Sensor health", told)
        return Report(_OK, "Normal", told)

    def _report_battery(self, number: int) -> Report:
        battery = self._batteries.get(number)
        if battery is None:
            return Report(_ERROR, "No data", [("Voltage", "-1.00"), ("Current", "0.0"), ("Remaining", "0.0")])
        cells = cell_voltages(battery)
        voltage = sum(cells)
        current = math.nan if battery.current_battery == -1 else -battery.current_battery / 100.0
        values = [
            ("Voltage", f"{voltage:.2f}"),
            ("Current", f"{current:.1f}"),
            ("Remaining", f"{battery.battery_remaining:.1f}"),
        ]
        if len(cells) > 1:
            values += [(f"Cell {index}", f"{cell:.2f}") for index, cell in enumerate(cells, 1)]
        if voltage < self._min_voltages[number]:
            return Report(_WARN, "Low voltage", values)
        return Report(_OK, "Normal", values)

    def _report_time(self) -> Report:
        level, summary, frequency = self._syncs.report(self.uas.now_ns)
        count = self._syncs.count
        mean = self._round_trips_ns / count / 1e6 if count else 0.0
        return Report(
            level,
            summary,
            [
                ("Timesyncs since startup", str(count)),
                ("Frequency (Hz)", f"{frequency:f}"),
                ("Last RTT (ms)", f"{self._round_trip_ns / 1e6:.6f}"),
                ("Mean RTT (ms)", f"{mean:.6f}"),
                ("Last remote time (s)", f"{self._remote_ns / 1e9:.9f}"),
                ("Estimated time offset (s)", f"{(self.uas.time_offset_ns or 0) / 1e9:.9f}"),
            ],
        )


class _LinkCounts:
    """Traffic of a link, counted while there is a subscriber."""

    def __init__(self) -> None:
        self._packets = self._bytes = self._dropped = self._told_dropped = 0
        self._sequences: dict[tuple[int, int], int] = {}  # next sequence number of each sender
        self._sequence = 0
        self._last: tuple[int, int, int] = (0, 0, 0)  # time, bytes received, bytes sent

    def count(self, frame: bytes) -> None:
        """Count a frame, and any frames missing before it."""
        at = 4 if frame[0] == mavlink.PROTOCOL_MARKER_V2 else 2
        self._sequence, sender = frame[at], (frame[at + 1], frame[at + 2])
        expected = self._sequences.get(sender)
        if expected is not None:
            self._dropped += (self._sequence - expected) & 0xFF
        self._sequences[sender] = (self._sequence + 1) & 0xFF
        self._packets += 1
        self._bytes += len(frame)

    def pause(self) -> None:
        """Pause counting: frames that arrive meanwhile are not missing."""
        self._sequences.clear()

    def restart(self, uas: Uas) -> None:
        """Restart the measurement of data rates."""
        self._last = uas.now_ns, self._bytes, uas.link.sent_bytes

    def report(self, uas: Uas) -> Report:
        """Return MAVROS's status "FCU connection"."""
        then_ns, received, sent = self._last
        self._last = uas.now_ns, self._bytes, uas.link.sent_bytes
        seconds = (uas.now_ns - then_ns) / _NS
        new, self._told_dropped = self._dropped - self._told_dropped, self._dropped
        rates = [(now - before) / seconds if seconds > 0.0 else 0.0
                 for now, before in zip(self._last[1:], (received, sent), strict=True)]  # fmt: skip
        values = [
            ("Received packets:", str(self._packets)),
            ("Dropped packets:", str(self._dropped)),
            ("Buffer overruns:", "0"),
            ("Parse errors:", str(uas.link.malformed)),
            ("Rx sequence number:", str(self._sequence)),
            ("Tx sequence number:", str(uas.link.sequence)),
            ("Rx total bytes:", str(self._bytes)),
            ("Tx total bytes:", str(uas.link.sent_bytes)),
            ("Rx speed:", f"{rates[0]:f}"),
            ("Tx speed:", f"{rates[1]:f}"),
        ]
        if new > 0:
            return Report(_WARN, f"{new} packages dropped since last report", values)
        return Report(_OK, "connected", values) if uas.connected else Report(_WARN, "not connected", values)


def _min_voltages(params: Params) -> list[float]:
    """Return ``sys/min_voltage``: minimum voltage of each battery, V; MAVROS has at most ten.

    Raises:
        ParamError: the value is neither a number nor a list of numbers.
    """
    value = params.get_any("sys/min_voltage", [_DEFAULT_MIN_VOLTAGE])
    values = value if isinstance(value, list) else [value]
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in values):
        raise ParamError(f"parameter sys/min_voltage: {value!r} is neither a number of volts nor a list of them")
    return [float(v) for v in values[:_MOST_BATTERIES]]


def _describe(enum: str, value: int) -> str:
    """Return MAVROS's text for an enumeration value: the beginning of MAVLink's description."""
    entry = mavlink.enums[enum].get(value)
    if entry is None:
        return str(value)
    words = entry.description
    for mark in ",-/.":
        words = words.split(mark)[0]
    return str(words).strip()


def _precision(value: int) -> str:
    return "Unknown" if value == _UNKNOWN else f"{value / 100.0:.2f}"


def _sensors() -> list[tuple[int, str]]:
    """Return the bits of SYS_STATUS with MAVROS's names: MAVLink's descriptions without the number."""
    found = []
    for bit, entry in sorted(mavlink.enums["MAV_SYS_STATUS_SENSOR"].items()):
        if not entry.name.endswith("ENUM_END"):
            words = entry.description
            found.append((bit, (words.split(" ", 1)[1] if words.startswith("0x") else words).strip()))
    return found


_SENSORS = _sensors()
