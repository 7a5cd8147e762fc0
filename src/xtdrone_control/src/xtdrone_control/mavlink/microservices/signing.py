"""SETUP_SIGNING: MAVLink 2 signing is not supported.

Frames are sent unsigned, and the signatures of received frames are ignored, as by PX4 v1.14 before a key is set up;
here none can be set up.
"""

from __future__ import annotations

from typing import Any, ClassVar

from xtdrone_control.autopilot.commander.commander import WARNING
from xtdrone_control.mavlink.client_link import Link
from xtdrone_control.mavlink.service_base import Service, Vehicle


class SigningService(Service):
    """Warns once that signing is not supported."""

    MESSAGES: ClassVar[dict[str, str]] = {"SETUP_SIGNING": "_setup_signing"}

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        self._warned = False

    def _setup_signing(self, _link: Link, _m: Any) -> None:
        if not self._warned:
            self._warned = True
            self.vehicle.commander.say(WARNING, "MAVLink signing is not supported")
