"""State of the autopilot: heartbeat, version, battery, texts, estimator flags; mode and message rates on request.

In addition to MAVROS's behaviour, reasons that PX4 reports only as events are logged and published with the texts
(``refusals``).
"""

from __future__ import annotations

import logging
import threading
from typing import Any

from mavros_msgs.msg import EstimatorStatus, ExtendedState, State, StatusText, SysStatus, VehicleInfo
from mavros_msgs.srv import (
    MessageInterval,
    MessageIntervalResponse,
    SetMode,
    SetModeResponse,
    StreamRate,
    StreamRateResponse,
    VehicleInfoGet,
    VehicleInfoGetResponse,
)
from pymavlink.dialects.v20 import common as mavlink
from sensor_msgs.msg import BatteryState

from xtdrone_autopilot.mavlink.wire.codec import decoder, version
from xtdrone_common.modes import ModeError, mode_name, mode_number
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.lib.plugin_settings import ParamError
from xtdrone_mavros.uas import Plugin, Uas

_NO_CELL = 65535
_CONTINUED = 65534  # the next field's voltage is added


def cell_voltages(battery: Any) -> list[float]:
    """Return the voltages (V) of a BATTERY_STATUS as MAVROS reads them (sys_status.cpp, handle_battery_status).

    Fields after the first unused one are ignored. A cell of 0 V counts in ``voltages``, where 65535 marks an unused
    field, but not in ``voltages_ext``, where MAVLink 2 cuts zeros off. A cell above 65.534 V continues in the next
    field.
    """
    cells: list[float] = []
    carried = 0.0
    for fields, ends in ((battery.voltages, (_NO_CELL,)), (battery.voltages_ext, (_NO_CELL, 0))):
        for millivolts in fields:
            if millivolts in ends:
                break
            carried += millivolts / 1000.0
            if millivolts != _CONTINUED:
                cells.append(carried)
                carried = 0.0
    return cells


log = logging.getLogger("rosout.mavros")

_NS = 1_000_000_000
_NAN = float("nan")
# s of wall time. MAVROS does not wait; waiting keeps the order in a simulation that stands still meanwhile.
_MODE_ACK_LIMIT = 0.5
_VERSION_LIMIT = 2.0  # s, wall, between the ack of the request and the version
_MAVLINK_VERSION = 3  # the heartbeat's mavlink_version field
_TEXT_LENGTH = 50  # bytes of a STATUSTEXT
_CURRENT_UNKNOWN = -1  # cA

_LOG_LEVELS = {0: log.error, 1: log.error, 2: log.error, 3: log.error, 4: log.warning, 5: log.warning, 6: log.info}

# MAV_BATTERY_TYPE to BatteryState.POWER_SUPPLY_TECHNOLOGY_*
_TECHNOLOGY = {
    mavlink.MAV_BATTERY_TYPE_LIPO: BatteryState.POWER_SUPPLY_TECHNOLOGY_LIPO,
    mavlink.MAV_BATTERY_TYPE_LIFE: BatteryState.POWER_SUPPLY_TECHNOLOGY_LIFE,
    mavlink.MAV_BATTERY_TYPE_LION: BatteryState.POWER_SUPPLY_TECHNOLOGY_LION,
    mavlink.MAV_BATTERY_TYPE_NIMH: BatteryState.POWER_SUPPLY_TECHNOLOGY_NIMH,
}

# the fields common to AUTOPILOT_VERSION and VehicleInfo
_VERSION_FIELDS = (
    "capabilities",
    "flight_sw_version",
    "middleware_sw_version",
    "os_sw_version",
    "board_version",
    "vendor_id",
    "product_id",
    "uid",
)

_ESTIMATOR_FLAGS = {
    "attitude_status_flag": mavlink.ESTIMATOR_ATTITUDE,
    "velocity_horiz_status_flag": mavlink.ESTIMATOR_VELOCITY_HORIZ,
    "velocity_vert_status_flag": mavlink.ESTIMATOR_VELOCITY_VERT,
    "pos_horiz_rel_status_flag": mavlink.ESTIMATOR_POS_HORIZ_REL,
    "pos_horiz_abs_status_flag": mavlink.ESTIMATOR_POS_HORIZ_ABS,
    "pos_vert_abs_status_flag": mavlink.ESTIMATOR_POS_VERT_ABS,
    "pos_vert_agl_status_flag": mavlink.ESTIMATOR_POS_VERT_AGL,
    "const_pos_mode_status_flag": mavlink.ESTIMATOR_CONST_POS_MODE,
    "pred_pos_horiz_rel_status_flag": mavlink.ESTIMATOR_PRED_POS_HORIZ_REL,
    "pred_pos_horiz_abs_status_flag": mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS,
    "gps_glitch_status_flag": mavlink.ESTIMATOR_GPS_GLITCH,
    "accel_error_status_flag": mavlink.ESTIMATOR_ACCEL_ERROR,
}


_decode_version = decoder("AUTOPILOT_VERSION")


class SysStatusPlugin(Plugin):
    """MAVROS's sys_status. Unknown values of ``battery`` are MAVROS's (sys_status.cpp, handle_battery_status).

    ``vehicle_info_get`` covers only the autopilot, and requests its version on first use.
    """

    name = "sys_status"

    def __init__(self, uas: Uas) -> None:
        """Advertise topics and services, and start sending heartbeats.

        Raises:
            ParamError: ``conn/heartbeat_mav_type`` is not a MAVLink type.
        """
        super().__init__(uas)
        self._timeout_ns = round(uas.params.get("conn/timeout", 10.0) * _NS)
        rate = uas.params.get("conn/heartbeat_rate", 1.0)
        self._own_type = _vehicle_type(uas.params.get("conn/heartbeat_mav_type", "ONBOARD_CONTROLLER"))
        self._last_heartbeat_ns = 0
        self._text_parts: list[str] = []
        self._armed = False
        self._booted = False
        self._announced = False  # whether a state has been published
        self._version: Any = None
        self._version_known = threading.Event()
        self._info_ns = 0  # time at which either of them arrived
        self._state = uas.topic("state", State(), latch=True)
        self._extended = uas.topic("extended_state", ExtendedState())
        self._battery = uas.topic("battery", BatteryState())
        self._estimator = uas.topic("estimator_status", EstimatorStatus())
        self._sys_status = uas.topic("sys_status", SysStatus())
        self._text = uas.topic("statustext/recv", StatusText())
        self.messages = {
            "HEARTBEAT": Feed(self._on_heartbeat, always=True),
            "STATUSTEXT": Feed(self._on_text, always=True),
            "EVENT": Feed(self._on_event, always=True),
            "EXTENDED_SYS_STATE": Feed(self._on_extended, self._extended),
            "BATTERY_STATUS": Feed(self._on_battery, self._battery),
            "ESTIMATOR_STATUS": Feed(self._on_estimator, self._estimator),
            "SYS_STATUS": Feed(self._on_sys_status, self._sys_status),
        }
        self.replies = {"AUTOPILOT_VERSION": self._on_version}
        uas.subscribe("statustext/send", StatusText, self._send_text)
        uas.service("set_mode", SetMode, self._set_mode)
        uas.service("set_message_interval", MessageInterval, self._set_message_interval)
        uas.service("set_stream_rate", StreamRate, self._set_stream_rate)
        uas.service("vehicle_info_get", VehicleInfoGet, self._vehicle_info_get)
        if rate > 0.0:
            uas.timer(1.0 / rate, self._send_heartbeat)
        uas.timer(min(1.0, self._timeout_ns / _NS), self._check_connection)

    def connected(self, connected: bool) -> None:
        """Publish the state after a loss (not connected, not armed, no mode), and drop the version."""
        self._version = None
        self._version_known.clear()
        if not connected:
            self._armed = self._booted = False
            self._publish_disconnection()

    def _publish_disconnection(self) -> None:
        self._announced = True
        state = self._state.message = State()
        self.uas.stamp_now(state.header)
        self._state.publish(state)

    def _send_heartbeat(self) -> None:
        self.uas.link.send(
            mavlink.MAVLink_heartbeat_message(
                self._own_type,
                mavlink.MAV_AUTOPILOT_INVALID,
                mavlink.MAV_MODE_MANUAL_ARMED,
                0,
                mavlink.MAV_STATE_ACTIVE,
                _MAVLINK_VERSION,
            )
        )

    def _check_connection(self) -> None:
        """Publish a lost connection, and once the missing one of the start, as MAVROS does."""
        if not self._announced:
            self._publish_disconnection()
        if self.uas.connected and self.uas.now_ns - self._last_heartbeat_ns > self._timeout_ns:
            self.uas.set_connected(False)

    def _on_heartbeat(self, heartbeat: Any) -> None:
        uas = self.uas
        self._last_heartbeat_ns = self._info_ns = uas.now_ns
        uas.heartbeat = heartbeat
        booted = heartbeat.system_status not in (mavlink.MAV_STATE_UNINIT, mavlink.MAV_STATE_BOOT)
        if self._booted and not booted:
            uas.on_reboot()
        if booted and not self._booted:
            uas.on_booted(uas.name)
        self._booted = booted
        state = self._state.message
        uas.stamp_now(state.header)
        state.connected = True
        state.armed = self._armed = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        state.guided = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_GUIDED_ENABLED)
        state.manual_input = bool(heartbeat.base_mode & mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED)
        state.mode = mode_name(heartbeat.base_mode, heartbeat.custom_mode)
        state.system_status = heartbeat.system_status
        uas.refusals.custom_mode = heartbeat.custom_mode
        uas.set_connected(True)
        self._announced = True
        self._state.publish(state)

    def _on_extended(self, extended: Any) -> None:
        message = self._extended.message
        self.uas.stamp_now(message.header)
        message.vtol_state = extended.vtol_state
        message.landed_state = extended.landed_state
        self._extended.publish(message)

    def _on_battery(self, battery: Any) -> None:
        message = self._battery.message
        self.uas.stamp_now(message.header)
        message.cell_voltage = cells = cell_voltages(battery)
        message.voltage = sum(cells)
        # BatteryState counts a discharge current as negative, MAVLink as positive. PX4's "unknown" is -1 A, not
        # MAVLink's -1 cA, and comes out as 1 A, as in MAVROS.
        unknown = battery.current_battery == _CURRENT_UNKNOWN
        message.current = _NAN if unknown else -battery.current_battery / 100.0
        message.charge = message.capacity = message.design_capacity = _NAN
        message.percentage = battery.battery_remaining / 100.0  # -0.01: unknown
        message.power_supply_status = BatteryState.POWER_SUPPLY_STATUS_DISCHARGING
        message.power_supply_health = BatteryState.POWER_SUPPLY_HEALTH_UNKNOWN
        message.power_supply_technology = _TECHNOLOGY.get(battery.type, BatteryState.POWER_SUPPLY_TECHNOLOGY_UNKNOWN)
        message.present = True
        message.location = f"id{battery.id}"
        self._battery.publish(message)

    def _on_estimator(self, status: Any) -> None:
        message = self._estimator.message
        self.uas.stamp_now(message.header)
        for field, flag in _ESTIMATOR_FLAGS.items():
            setattr(message, field, bool(status.flags & flag))
        self._estimator.publish(message)

    def _on_sys_status(self, status: Any) -> None:
        message = self._sys_status.message
        self.uas.stamp_now(message.header)
        message.sensors_present = status.onboard_control_sensors_present
        message.sensors_enabled = status.onboard_control_sensors_enabled
        message.sensors_health = status.onboard_control_sensors_health
        for field in (
            "load",
            "voltage_battery",
            "current_battery",
            "battery_remaining",
            "drop_rate_comm",
            "errors_comm",
            "errors_count1",
            "errors_count2",
            "errors_count3",
            "errors_count4",
        ):
            setattr(message, field, getattr(status, field))
        self._sys_status.publish(message)

    def _on_text(self, status: Any) -> None:
        """Handle a text; a long one arrives in chunks with the same id, all full except the last."""
        text = _text(status.text)
        if status.id:
            if status.chunk_seq == 0:
                self._text_parts = []
            self._text_parts.append(text)
            if len(text.encode()) == _TEXT_LENGTH:
                return
            text, self._text_parts = "".join(self._text_parts), []
        self._publish_text(status.severity, text)

    def _on_event(self, event: Any) -> None:
        for severity, text in self.uas.refusals.process(event, self.uas.now_ns):
            self._publish_text(severity, text)

    def _publish_text(self, severity: int, text: str) -> None:
        """Log and publish a text; a trailing tab marks a text that is also sent as an event."""
        _LOG_LEVELS.get(severity, log.debug)("%s: FCU: %s", self.uas.name, text.rstrip("\t"))
        if self._text.needed:
            message = self._text.message
            self.uas.stamp_now(message.header)
            message.severity = severity
            message.text = text
            self._text.publish(message)

    def _send_text(self, text: StatusText) -> None:
        data = text.text.encode("utf-8", "replace")
        if len(data) > _TEXT_LENGTH:
            self.uas.warn("statustext", "statustext/send: text of %d bytes is cut to %d", len(data), _TEXT_LENGTH)
        self.uas.link.send(mavlink.MAVLink_statustext_message(text.severity, data[:_TEXT_LENGTH]))

    def _set_mode(self, request: Any) -> SetModeResponse:
        """Send SET_MODE; as in MAVROS, ``mode_sent`` means that it was sent, not that the autopilot accepted it."""
        base_mode, custom_mode = request.base_mode, 0
        if request.custom_mode:
            try:
                custom_mode = mode_number(request.custom_mode)
            except ModeError as error:
                log.error("%s: set_mode: %s", self.uas.name, error)
                return SetModeResponse(mode_sent=False)
            armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self._armed else 0
            base_mode = armed | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        message = mavlink.MAVLink_set_mode_message(self.uas.target[0], base_mode, custom_mode)
        result = self.uas.commands.call(
            mavlink.MAV_CMD_DO_SET_MODE, lambda _: message, limit=_MODE_ACK_LIMIT, resends=0
        )
        if result == mavlink.MAV_RESULT_ACCEPTED:
            self.uas.refusals.custom_mode = custom_mode  # before the next heartbeat reports it
        elif result is not None:
            log.warning("%s: set_mode: the autopilot refused %s, result %d", self.uas.name, request.custom_mode, result)
        return SetModeResponse(mode_sent=True)

    def _set_message_interval(self, request: Any) -> MessageIntervalResponse:
        """Set a message's rate in Hz; 0 selects the autopilot's default, a negative rate switches it off."""
        rate = request.message_rate
        if not self.uas.finite("set_message_interval", [("message_rate", rate)]):
            return MessageIntervalResponse(success=False)
        interval_us = 1e6 / rate if rate > 0.0 else 0.0 if rate == 0.0 else -1.0
        self.uas.streams.leave(request.message_id)
        system, component = self.uas.target
        command = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        result = self.uas.commands.call(
            command,
            lambda attempt: mavlink.MAVLink_command_long_message(
                system, component, command, attempt, float(request.message_id), interval_us, 0.0, 0.0, 0.0, 0.0, 0.0
            ),
        )
        return MessageIntervalResponse(success=result == mavlink.MAV_RESULT_ACCEPTED)

    def _set_stream_rate(self, request: Any) -> StreamRateResponse:
        system, component = self.uas.target
        self.uas.link.send(
            mavlink.MAVLink_request_data_stream_message(
                system, component, request.stream_id, request.message_rate, int(request.on_off)
            )
        )
        return StreamRateResponse()

    def _on_version(self, frame: bytes) -> None:
        """Handle AUTOPILOT_VERSION in the receiver thread."""
        component = frame[6] if version(frame) == 2 else frame[4]
        if component == self.uas.target[1]:  # otherwise it is a camera's, for example
            self._version = _decode_version(frame)
            self._info_ns = self.uas.now_ns
            self._version_known.set()

    def _vehicle_info_get(self, request: Any) -> VehicleInfoGetResponse:
        heartbeat, asked = self.uas.heartbeat, (request.sysid, request.compid)
        known = heartbeat is not None
        if not request.get_all and not (known and asked in ((0, 0), self.uas.target)):
            return VehicleInfoGetResponse(success=False)
        if known and self._version is None:
            self._request_version()
        return VehicleInfoGetResponse(success=True, vehicles=[self._vehicle_info(heartbeat)] if known else [])

    def _request_version(self) -> None:
        """Request the version, and wait for it if the autopilot accepts."""
        command = mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
        result = self.uas.commands.call(
            command,
            lambda attempt: mavlink.MAVLink_command_long_message(
                *self.uas.target, command, attempt, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            ),
        )
        if result == mavlink.MAV_RESULT_ACCEPTED:
            with self.uas.ros.needs_time():
                self._version_known.wait(_VERSION_LIMIT)

    def _vehicle_info(self, heartbeat: Any) -> VehicleInfo:
        info = VehicleInfo(available_info=VehicleInfo.HAVE_INFO_HEARTBEAT)
        info.header.stamp.secs, info.header.stamp.nsecs = divmod(self._info_ns, _NS)
        info.sysid, info.compid = self.uas.target
        for field in ("autopilot", "type", "system_status", "base_mode", "custom_mode"):
            setattr(info, field, getattr(heartbeat, field))
        info.mode = mode_name(heartbeat.base_mode, heartbeat.custom_mode)
        custom = heartbeat.base_mode & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        info.mode_id = heartbeat.custom_mode if custom else heartbeat.base_mode
        found = self._version
        if found is not None:
            info.available_info |= VehicleInfo.HAVE_INFO_AUTOPILOT_VERSION
            for field in _VERSION_FIELDS:
                setattr(info, field, getattr(found, field))
            info.flight_custom_version = f"{int.from_bytes(bytes(found.flight_custom_version), 'little'):016x}"
        return info


def _vehicle_type(name: str) -> int:
    number = getattr(mavlink, f"MAV_TYPE_{name}", None)
    if number is None:
        raise ParamError(f"parameter conn/heartbeat_mav_type: {name!r} is not a MAV_TYPE, such as ONBOARD_CONTROLLER")
    return int(number)


def _text(data: Any) -> str:
    if isinstance(data, bytes):
        data = data.decode("utf-8", "replace")
    return data.rstrip("\0")
