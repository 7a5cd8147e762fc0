"""Commands: services that send COMMAND_LONG and wait for the ack; COMMAND_INT and COMMAND_ACK do not wait."""

from __future__ import annotations

from typing import Any

from mavros_msgs.srv import (
    CommandAck,
    CommandAckResponse,
    CommandBool,
    CommandBoolResponse,
    CommandHome,
    CommandHomeResponse,
    CommandInt,
    CommandIntResponse,
    CommandLong,
    CommandLongResponse,
    CommandTOL,
    CommandTOLResponse,
    CommandTriggerControl,
    CommandTriggerControlResponse,
    CommandTriggerInterval,
    CommandTriggerIntervalResponse,
    CommandVtolTransition,
    CommandVtolTransitionResponse,
)
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.codec import decoder
from xtdrone_mavros.link.command_acks import ACK_LIMIT
from xtdrone_mavros.relayed_messages import wrap_bits
from xtdrone_mavros.uas import Plugin, Uas

_SYSTEM_CONTROL = 250  # MAV_COMP_ID_SYSTEM_CONTROL
_decode_ack = decoder("COMMAND_ACK")


class CommandPlugin(Plugin):
    """MAVROS's command: ``success`` means that the ack is "accepted"; without an ack the result is 4, failed.

    As in MAVROS, ``command_int`` and ``command_ack`` succeed once the message is sent.
    """

    name = "command"

    def __init__(self, uas: Uas) -> None:
        """Offer the services."""
        super().__init__(uas)
        self._limit = uas.params.get("cmd/command_ack_timeout", ACK_LIMIT)  # s, wall
        system, component = uas.target
        quirk = uas.params.get("cmd/use_comp_id_system_control", False)
        self._target = system, _SYSTEM_CONTROL if quirk else component
        self._arming = False  # whether the last arm/disarm command was to arm
        self.replies = {"COMMAND_ACK": self._on_ack}
        uas.service("cmd/command", CommandLong, self._command)
        uas.service("cmd/command_int", CommandInt, self._command_int)
        uas.service("cmd/command_ack", CommandAck, self._command_ack)
        uas.service("cmd/arming", CommandBool, self._arm)
        uas.service("cmd/set_home", CommandHome, self._set_home)
        uas.service("cmd/takeoff", CommandTOL, self._takeoff)
        uas.service("cmd/land", CommandTOL, self._land)
        uas.service("cmd/trigger_control", CommandTriggerControl, self._trigger_control)
        uas.service("cmd/trigger_interval", CommandTriggerInterval, self._trigger_interval)
        uas.service("cmd/vtol_transition", CommandVtolTransition, self._vtol_transition)

    def _on_ack(self, frame: bytes) -> None:
        """Handle an ack in the receiver thread, before the events with the reasons for refused arming."""
        self.uas.commands.on_ack(frame)
        ack = _decode_ack(frame)
        refused = ack.result == mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        if refused and self._arming and ack.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            self.uas.refusals.arming_refused(self.uas.now_ns)

    def _call(self, command: int, *params: float) -> tuple[bool, int]:
        """Send COMMAND_LONG with up to seven parameters; return success and MAV_RESULT."""
        values = (*params, *(0.0,) * (7 - len(params)))
        if command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            self._arming = values[0] == 1.0
            if self._arming and self.uas.arming_held:
                self.uas.warn("arming", "not armed yet: %s", self.uas.arming_held)
                return False, mavlink.MAV_RESULT_TEMPORARILY_REJECTED
        self.uas.streams.note_command(command, values[0])
        result = self.uas.commands.call(
            command,
            lambda attempt: mavlink.MAVLink_command_long_message(*self._target, command, attempt, *values),
            limit=self._limit,
        )
        if result is None:
            self.uas.warn(f"command {command}", "command %d: the autopilot has not answered", command)
            return False, mavlink.MAV_RESULT_FAILED
        return result == mavlink.MAV_RESULT_ACCEPTED, result

    def _command(self, request: Any) -> CommandLongResponse:
        params = (getattr(request, f"param{i}") for i in range(1, 8))
        if request.broadcast:
            self.uas.streams.note_command(request.command, request.param1)
            message = mavlink.MAVLink_command_long_message(0, 0, request.command, request.confirmation, *params)
            self.uas.link.send(message)
            return CommandLongResponse(True, mavlink.MAV_RESULT_ACCEPTED)
        return CommandLongResponse(*self._call(request.command, *params))

    def _command_int(self, request: Any) -> CommandIntResponse:
        message = mavlink.MAVLink_command_int_message(
            *((0, 0) if request.broadcast else self._target),
            request.frame,
            request.command,
            request.current,
            request.autocontinue,
            request.param1,
            request.param2,
            request.param3,
            request.param4,
            request.x,
            request.y,
            request.z,
        )
        self.uas.streams.note_command(request.command, request.param1)
        if request.broadcast:
            self.uas.link.send(message)
        else:
            self.uas.commands.send(request.command, message)
        return CommandIntResponse(True)

    def _command_ack(self, request: Any) -> CommandAckResponse:
        """Acknowledge a command sent by the autopilot."""
        param2 = wrap_bits(request.result_param2, 32)
        self.uas.link.send(
            mavlink.MAVLink_command_ack_message(
                request.command, request.result, request.progress, param2, *self._target
            )
        )
        return CommandAckResponse(True, mavlink.MAV_RESULT_ACCEPTED)

    def _arm(self, request: Any) -> CommandBoolResponse:
        arm = 1.0 if request.value else 0.0
        return CommandBoolResponse(*self._call(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, arm))

    def _set_home(self, request: Any) -> CommandHomeResponse:
        current = 1.0 if request.current_gps else 0.0
        place = request.latitude, request.longitude, request.altitude
        return CommandHomeResponse(*self._call(mavlink.MAV_CMD_DO_SET_HOME, current, 0.0, 0.0, request.yaw, *place))

    def _takeoff(self, request: Any) -> CommandTOLResponse:
        place = request.latitude, request.longitude, request.altitude
        params = (request.min_pitch, 0.0, 0.0, request.yaw, *place)
        return CommandTOLResponse(*self._call(mavlink.MAV_CMD_NAV_TAKEOFF, *params))

    def _land(self, request: Any) -> CommandTOLResponse:
        place = request.latitude, request.longitude, request.altitude
        return CommandTOLResponse(*self._call(mavlink.MAV_CMD_NAV_LAND, 0.0, 0.0, 0.0, request.yaw, *place))

    def _trigger_control(self, request: Any) -> CommandTriggerControlResponse:
        switches = (request.trigger_enable, request.sequence_reset, request.trigger_pause)
        return CommandTriggerControlResponse(*self._call(mavlink.MAV_CMD_DO_TRIGGER_CONTROL, *map(float, switches)))

    def _trigger_interval(self, request: Any) -> CommandTriggerIntervalResponse:
        """Set the times (ms), which the autopilot accepts while triggering is off."""
        times = request.cycle_time, request.integration_time
        return CommandTriggerIntervalResponse(*self._call(mavlink.MAV_CMD_DO_SET_CAM_TRIGG_INTERVAL, *times))

    def _vtol_transition(self, request: Any) -> CommandVtolTransitionResponse:
        state = float(request.state)
        return CommandVtolTransitionResponse(*self._call(mavlink.MAV_CMD_DO_VTOL_TRANSITION, state))
