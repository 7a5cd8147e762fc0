"""COMMAND_LONG, COMMAND_INT and SET_MODE, with their acknowledgements."""

from __future__ import annotations

from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.mavlink.commands import Command, CommandHandler, from_command_int
from xtdrone_control.mavlink.link import Link
from xtdrone_control.mavlink.service import Service, Vehicle


class CommandService(Service):
    """Obeys commands and acknowledges them."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "COMMAND_LONG": "_command_long",
        "COMMAND_INT": "_command_int",
        "SET_MODE": "_set_mode",
    }

    def __init__(self, vehicle: Vehicle) -> None:
        """Serve ``vehicle``."""
        super().__init__(vehicle)
        self._commands = CommandHandler(vehicle.commander)

    def run(self, command: Command, link: Link) -> int:
        """Obey ``command``; return its MAV_RESULT. Answers other than the acknowledgement are queued on ``link``."""
        return self._commands.run(command, link, self.vehicle.now_us)

    def _command_long(self, link: Link, m: Any) -> None:
        params = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
        self._run(link, Command(m.command, params))

    def _command_int(self, link: Link, m: Any) -> None:
        params = (m.param1, m.param2, m.param3, m.param4)
        self._run(link, from_command_int(m.command, m.frame, params, m.x, m.y, m.z))

    def _run(self, link: Link, command: Command) -> None:
        self._acknowledge(link, command.number, self.run(command, link))

    def _acknowledge(self, link: Link, command: int, result: int) -> None:
        link.send_message(mavlink.MAVLink_command_ack_message(command, result, 0, 0, *link.sender))

    def _set_mode(self, link: Link, m: Any) -> None:
        result = self.vehicle.commander.set_mode(m.base_mode, m.custom_mode)
        self._acknowledge(link, mavlink.MAV_CMD_DO_SET_MODE, result)
