"""COMMAND_LONG, COMMAND_INT and SET_MODE with their acknowledgements, SET_GPS_GLOBAL_ORIGIN and SET_HOME_POSITION.

As in PX4, a command must address this system and its autopilot (or all components); other commands, and commands whose
sender id is this autopilot, are silently ignored. Only requests of version and capabilities may be broadcast to all
systems. A repeated command (``confirmation`` above 0) is executed and acknowledged again.
"""

from __future__ import annotations

from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.commander import WARNING, Result
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.commands.command_execution import (
    Command,
    CommandError,
    CommandHandler,
    from_command_int,
    from_command_long,
)
from xtdrone_autopilot.mavlink.service_base import Service, Vehicle
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_autopilot.mavlink.wire.frame_packing import COMPONENT_ID
from xtdrone_autopilot.vehicle_view import move_origin

_FOR_ALL_SYSTEMS = (mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION, mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES)


class CommandService(Service):
    """Executes commands and acknowledges them."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "COMMAND_LONG": "_command_long",
        "COMMAND_INT": "_command_int",
        "SET_MODE": "_set_mode",
    }
    CAPABILITIES = (
        mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
        | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    )

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._commands = CommandHandler(vehicle)

    def run(self, command: Command, link: Link) -> Result | None:
        """Execute ``command`` and queue replies on ``link``; return its result, None for no acknowledgement."""
        result = self._commands.run(command, link)
        log_command = self.vehicle.commander.on_command
        if log_command is not None:
            log_command(command.number, command.params, link.sender, result)
        return result

    def _is_for_us(self, link: Link, m: Any) -> bool:
        if link.sender == (self.vehicle.system_id, COMPONENT_ID):
            return False
        return m.target_system == self.vehicle.system_id or m.command in _FOR_ALL_SYSTEMS

    def _command_long(self, link: Link, m: Any) -> None:
        if self._is_for_us(link, m):
            params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
            try:
                self._acknowledge(link, m.command, self.run(from_command_long(m.command, params), link))
            except CommandError as error:
                self._refuse(link, m.command, error)

    def _command_int(self, link: Link, m: Any) -> None:
        if self._is_for_us(link, m):
            params = (m.param1, m.param2, m.param3, m.param4)
            try:
                command = from_command_int(m.command, params, m.x, m.y, m.z)
                self._acknowledge(link, m.command, self.run(command, link))
            except CommandError as error:
                self._refuse(link, m.command, error)

    def _refuse(self, link: Link, command: int, error: CommandError) -> None:
        link.warn("command", str(error), self.vehicle.now_us)
        self._acknowledge(link, command, Result.DENIED)

    def _acknowledge(self, link: Link, command: int, result: Result | None) -> None:
        if result is not None:
            link.send_message(mavlink.MAVLink_command_ack_message(command, result, 0, 0, *link.sender))

    def _set_mode(self, link: Link, m: Any) -> None:
        result = self.vehicle.commander.set_mode(m.base_mode, m.custom_mode)
        self._acknowledge(link, mavlink.MAV_CMD_DO_SET_MODE, result)


class HomeService(Service):
    """Sets the local frame's origin and the home position."""

    MESSAGES: ClassVar[dict[str, str]] = {"SET_GPS_GLOBAL_ORIGIN": "_set_origin", "SET_HOME_POSITION": "_set_home"}

    def __init__(self, vehicle: Vehicle, commands: CommandService) -> None:
        """Register the service with ``vehicle``; ``command_execution`` sends the resulting origin."""
        super().__init__(vehicle)
        self._commands = commands
        self._estimator = vehicle.autopilot.estimator[vehicle.index]
        vehicle.on_request[mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN] = self._send_origin

    def _send_origin(self, link: Link) -> bool:
        """Send GPS_GLOBAL_ORIGIN, also unchanged; return whether there is one."""
        link.telemetry.refresh(self.vehicle.now_us)
        values = link.telemetry.flight.gps_global_origin()
        if values is not None:
            link.send_message(mavlink.MAVLink_gps_global_origin_message(*values))
        return values is not None

    def _set_origin(self, link: Link, m: Any) -> None:
        # as in PX4, an origin received in flight is silently ignored
        if self.vehicle.commander.view.landed:
            try:
                move_origin(self._estimator, m.latitude * 1e-7, m.longitude * 1e-7, m.altitude * 1e-3)
            except ValueError as error:
                self.vehicle.commander.say(WARNING, str(error))
        self._commands.run(
            Command(mavlink.MAV_CMD_REQUEST_MESSAGE, (MESSAGE_ID["GPS_GLOBAL_ORIGIN"], 0, 0, 0, 0, 0, 0)), link
        )

    def _set_home(self, _link: Link, m: Any) -> None:
        self.vehicle.call_or_queue(lambda: self._apply_home(m))

    def _apply_home(self, m: Any) -> None:
        if self.vehicle.commander.commands.set_home((m.latitude * 1e-7, m.longitude * 1e-7, m.altitude * 1e-3)):
            self.vehicle.commander.say(WARNING, "Home position rejected")
