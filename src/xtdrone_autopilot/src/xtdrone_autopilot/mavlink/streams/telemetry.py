"""All telemetry messages of one vehicle, found by the name of the message."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.mavlink.streams.device_telemetry import DeviceTelemetry
from xtdrone_autopilot.mavlink.streams.flight_telemetry import FlightTelemetry
from xtdrone_autopilot.mavlink.streams.navigation_telemetry import NavigationTelemetry
from xtdrone_autopilot.mavlink.streams.vehicle_state import Content, Values, VehicleState

if TYPE_CHECKING:
    from xtdrone_autopilot.autopilot import Autopilot

Source = Callable[[], Content | list[Values] | None]
"""Returns the content of a message, of several of one type, or None if there is nothing to send."""


def silent() -> None:
    """Return None: a message that is never sent."""


class Telemetry:
    """Telemetry of one vehicle.

    Attributes:
        vehicle: state from which the messages are built.
        flight, devices, navigation: messages by subject.
    """

    def __init__(self, commander: Commander, autopilot: Autopilot, index: int) -> None:
        """Read the records of vehicle ``index`` of ``autopilot``."""
        self.vehicle = VehicleState(commander, autopilot, index)
        self.flight = FlightTelemetry(self.vehicle)
        self.devices = DeviceTelemetry(self.vehicle)
        self.navigation = NavigationTelemetry(self.vehicle)
        self.refresh = self.vehicle.refresh

    @property
    def protocol(self) -> int:
        """MAV_PROTO_VER: 0 start with MAVLink 1, 1 always MAVLink 1, 2 start with MAVLink 2."""
        return int(self.vehicle.commander.parameters.get("MAV_PROTO_VER"))

    def source(self, name: str) -> Source:
        """Return the method that returns the content of message ``name``; ``silent`` if there is none."""
        parts = (self.flight, self.devices, self.navigation)
        found: Source = next((getattr(part, name.lower()) for part in parts if hasattr(part, name.lower())), silent)
        return found
