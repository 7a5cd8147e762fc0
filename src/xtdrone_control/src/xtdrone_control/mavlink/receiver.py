"""What one vehicle does with the MAVLink messages that it receives."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.commander import CRITICAL, WARNING, Commander
from xtdrone_control.autopilot.inputs import SetpointError
from xtdrone_control.autopilot.parameters import FLOAT, INT32, NAMES, ParameterError, describe
from xtdrone_control.mavlink.codec import FrameError, decoder, split

from . import setpoints
from .commands import Command, CommandHandler, from_command_int
from .link import COMPONENT_ID, Address, Link
from .packing import MESSAGE_ID

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

_GCS_TYPE = 6  # MAV_TYPE_GCS
_HASH_NAME = "_HASH_CHECK"
_HASH_TYPE = 5  # MAV_PARAM_TYPE_UINT32
_BROADCAST = 0
_MISSION_ACCEPTED, _MISSION_ERROR, _MISSION_UNSUPPORTED = 0, 1, 3  # MAV_MISSION_RESULT

# message, handler's name, field of the target system (empty: for everybody), of the target component
MESSAGES = (
    ("HEARTBEAT", "_heartbeat", "", ""),
    ("COMMAND_LONG", "_command_long", "target_system", "target_component"),
    ("COMMAND_INT", "_command_int", "target_system", "target_component"),
    ("SET_MODE", "_set_mode", "target_system", ""),
    ("SET_POSITION_TARGET_LOCAL_NED", "_local_target", "target_system", "target_component"),
    ("SET_POSITION_TARGET_GLOBAL_INT", "_global_target", "target_system", "target_component"),
    ("SET_ATTITUDE_TARGET", "_attitude_target", "target_system", "target_component"),
    ("MANUAL_CONTROL", "_manual_control", "target", ""),
    ("PARAM_REQUEST_LIST", "_param_request_list", "target_system", "target_component"),
    ("PARAM_REQUEST_READ", "_param_request_read", "target_system", "target_component"),
    ("PARAM_SET", "_param_set", "target_system", "target_component"),
    ("MISSION_REQUEST_LIST", "_mission_request_list", "target_system", "target_component"),
    ("MISSION_COUNT", "_mission_count", "target_system", "target_component"),
    ("MISSION_ITEM", "_mission_item", "target_system", "target_component"),
    ("MISSION_ITEM_INT", "_mission_item", "target_system", "target_component"),
    ("MISSION_CLEAR_ALL", "_mission_clear_all", "target_system", "target_component"),
    ("TIMESYNC", "_timesync", "", ""),
    ("PING", "_ping", "", ""),
    ("SET_GPS_GLOBAL_ORIGIN", "_set_origin", "target_system", ""),
    ("SET_HOME_POSITION", "_set_home", "target_system", ""),
)


class Receiver:
    """Acts on the messages of one vehicle. Nothing that comes in raises.

    In a tick of the lockstep, commands and requests come when some participant's service call makes them, and
    set-points and home positions when the MAVROS layer has its turn: which is first, the scheduler decides. Therefore
    the latter can be held until everybody is done; commands and requests, whose answers somebody waits for, then always
    come first. An origin (SET_GPS_GLOBAL_ORIGIN) is not held, for it is answered at once with the origin that holds.
    """

    def __init__(self, commander: Commander, autopilot: Autopilot, index: int) -> None:
        """Take the vehicle's commander and its place in ``autopilot``."""
        self._commander = commander
        self._parameters = commander.parameters
        self._estimator = autopilot.estimator[index]
        self._system_id = commander.vehicle.system_id
        self._commands = CommandHandler(commander)
        self._held: list[Callable[[], None]] | None = None
        self._now_us = 0
        self._sender = (0, 0)
        self._handlers: dict[int, tuple[Callable[[bytes], Any], Callable[[Link, Any], None], str, str]] = {
            MESSAGE_ID[name]: (decoder(name), getattr(self, handler), system, component)
            for name, handler, system, component in MESSAGES
        }

    def take(self, link: Link, datagram: bytes, sender: Address, now_us: int) -> None:
        """Act on every message in ``datagram``, which came over ``link`` from ``sender``; answers are queued there."""
        self._now_us = now_us
        try:
            for number, system, component, frame in split(datagram):
                entry = self._handlers.get(number)
                if entry is not None:
                    self._sender = (system, component)
                    self._dispatch(link, frame, sender, *entry)
        except FrameError as error:
            self._malformed(link, error)

    def _dispatch(
        self,
        link: Link,
        frame: bytes,
        sender: Address,
        decode: Callable[[bytes], Any],
        handle: Callable[[Link, Any], None],
        system_field: str,
        component_field: str,
    ) -> None:
        try:
            message = decode(frame)
        except (ValueError, struct.error, TypeError) as error:  # FrameError is a ValueError, as is bad text
            self._malformed(link, error)
            return
        if system_field and getattr(message, system_field) not in (_BROADCAST, self._system_id):
            link.foreign += 1
            wanted = getattr(message, system_field)
            link.warn("foreign", f"message for system {wanted} ignored, this is {self._system_id}", self._now_us)
            return
        link.heard(sender, self._now_us)
        if component_field and getattr(message, component_field) not in (_BROADCAST, COMPONENT_ID):
            return
        handle(link, message)

    def _malformed(self, link: Link, error: Exception) -> None:
        link.malformed += 1
        link.warn("malformed", f"bad MAVLink ignored: {error}", self._now_us)

    # presence and time

    def _heartbeat(self, _link: Link, m: Any) -> None:
        if m.type == _GCS_TYPE:
            self._commander.gcs_heartbeat()

    def _timesync(self, link: Link, m: Any) -> None:
        if m.tc1 == 0:
            link.send_message(mavlink.MAVLink_timesync_message(self._now_us * 1000, m.ts1))

    def _ping(self, link: Link, m: Any) -> None:
        if m.target_system == 0 and m.target_component == 0:
            link.send_message(mavlink.MAVLink_ping_message(m.time_usec, m.seq, *self._sender))

    # commands

    def _command_long(self, link: Link, m: Any) -> None:
        params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
        self._run(link, Command(m.command, params))

    def _command_int(self, link: Link, m: Any) -> None:
        params = (m.param1, m.param2, m.param3, m.param4)
        self._run(link, from_command_int(m.command, m.frame, params, m.x, m.y, m.z))

    def _run(self, link: Link, command: Command) -> None:
        result = self._commands.run(command, link, self._now_us)
        self._acknowledge(link, command.number, result)

    def _acknowledge(self, link: Link, command: int, result: int) -> None:
        link.send_message(mavlink.MAVLink_command_ack_message(command, result, 0, 0, *self._sender))

    def _set_mode(self, link: Link, m: Any) -> None:
        result = self._commander.set_mode(m.base_mode, m.custom_mode)
        self._acknowledge(link, mavlink.MAV_CMD_DO_SET_MODE, result)

    # steering

    def _local_target(self, link: Link, m: Any) -> None:
        self._steer(link, setpoints.local_target, m)

    def _global_target(self, link: Link, m: Any) -> None:
        self._steer(link, setpoints.global_target, m)

    def _attitude_target(self, link: Link, m: Any) -> None:
        self._steer(link, setpoints.attitude_target, m)

    def _manual_control(self, link: Link, m: Any) -> None:
        self._steer(link, setpoints.sticks, m)

    def hold(self) -> None:
        """Keep set-points and home positions from now on until ``release``."""
        self._held = [] if self._held is None else self._held

    def release(self) -> None:
        """Act on what was kept, in the order of its coming."""
        held, self._held = self._held, None
        for act in held or ():
            act()

    def _in_turn(self, act: Callable[[], None]) -> None:
        """Call ``act`` now, or at ``release``."""
        if self._held is None:
            act()
        else:
            self._held.append(act)

    def _steer(self, link: Link, take: Callable[[Commander, Any], None], m: Any) -> None:
        self._in_turn(lambda: self._take_setpoint(link, take, m))

    def _take_setpoint(self, link: Link, take: Callable[[Commander, Any], None], m: Any) -> None:
        try:
            take(self._commander, m)
        except SetpointError as error:
            self._commander.warn(f"Set-point rejected: {error}")
            link.warn("set-point", f"set-point rejected: {error}", self._now_us)

    # parameters

    def _param_request_list(self, link: Link, _m: Any) -> None:
        for name in NAMES:
            self._send_parameter(link, name)
        self._send_hash(link)

    def _param_request_read(self, link: Link, m: Any) -> None:
        if m.param_index < 0:
            name = m.param_id
        elif m.param_index < len(NAMES):
            name = NAMES[m.param_index]
        else:
            return
        if name == _HASH_NAME:
            self._send_hash(link)
        elif name in NAMES:
            self._send_parameter(link, name)

    def _param_set(self, link: Link, m: Any) -> None:
        value = m.param_value
        if m.param_type == INT32:
            (value,) = struct.unpack("<i", struct.pack("<f", value))
        try:
            self._parameters.set(m.param_id, value, m.param_type)
        except ParameterError as error:
            # PX4 answers nothing; the log says why
            link.warn("parameter", f"parameter not set: {error}", self._now_us)
            return
        self._send_parameter(link, m.param_id)

    def _send_parameter(self, link: Link, name: str) -> None:
        value: float = self._parameters.get(name)
        kind = FLOAT
        if describe(name).type == INT32:
            kind = INT32
            (value,) = struct.unpack("<f", struct.pack("<i", int(value)))
        link.send_message(
            mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(NAMES), NAMES.index(name))
        )

    def _send_hash(self, link: Link) -> None:
        (value,) = struct.unpack("<f", struct.pack("<I", self._parameters.hash()))
        link.send_message(
            mavlink.MAVLink_param_value_message(_HASH_NAME.encode(), value, _HASH_TYPE, len(NAMES), 0xFFFF)
        )

    # missions: there is none, and none can be loaded

    def _mission_request_list(self, link: Link, m: Any) -> None:
        link.send_message(mavlink.MAVLink_mission_count_message(*self._sender, 0, m.mission_type))

    def _mission_count(self, link: Link, m: Any) -> None:
        result = _MISSION_ACCEPTED
        if m.count:
            self._commander.say(CRITICAL, "Missions are not supported")
            result = _MISSION_UNSUPPORTED
        self._acknowledge_mission(link, result, m.mission_type)

    def _mission_item(self, link: Link, m: Any) -> None:
        self._acknowledge_mission(link, _MISSION_ERROR, m.mission_type)

    def _mission_clear_all(self, link: Link, m: Any) -> None:
        self._acknowledge_mission(link, _MISSION_ACCEPTED, m.mission_type)

    def _acknowledge_mission(self, link: Link, result: int, kind: int) -> None:
        link.send_message(mavlink.MAVLink_mission_ack_message(*self._sender, result, kind))

    # places

    def _set_origin(self, link: Link, m: Any) -> None:
        e = self._estimator
        place = (m.latitude * 1e-7, m.longitude * 1e-7)
        if e["origin_set"]:
            self._commander.say(WARNING, "GPS origin is already set")
        elif abs(place[0]) > 90.0 or abs(place[1]) > 180.0:
            self._commander.say(WARNING, f"GPS origin {place[0]:.4f}, {place[1]:.4f} is no place")
        else:
            e["origin_lat"], e["origin_lon"] = place
            e["origin_alt"] = m.altitude * 1e-3
            e["origin_set"] = 1
        self._commands.run(
            Command(mavlink.MAV_CMD_REQUEST_MESSAGE, (MESSAGE_ID["GPS_GLOBAL_ORIGIN"], 0, 0, 0, 0, 0, 0)),
            link,
            self._now_us,
        )

    def _set_home(self, _link: Link, m: Any) -> None:
        self._in_turn(lambda: self._take_home(m))

    def _take_home(self, m: Any) -> None:
        if self._commander.set_home((m.latitude * 1e-7, m.longitude * 1e-7, m.altitude * 1e-3)):
            self._commander.say(WARNING, "Home position rejected")
