"""SET_GPS_GLOBAL_ORIGIN and SET_HOME_POSITION."""

from __future__ import annotations

from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.commander.commander import WARNING
from xtdrone_control.autopilot.vehicle_view import move_origin
from xtdrone_control.mavlink.client_link import Link
from xtdrone_control.mavlink.commands.command_execution import Command
from xtdrone_control.mavlink.commands.command_service import CommandService
from xtdrone_control.mavlink.service_base import Service, Vehicle
from xtdrone_control.mavlink.wire.dialect import MESSAGE_ID


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
        if self.vehicle.commander.set_home((m.latitude * 1e-7, m.longitude * 1e-7, m.altitude * 1e-3)):
            self.vehicle.commander.say(WARNING, "Home position rejected")
