"""SETUP_SIGNING: MAVLink 2 signing is not supported.

Frames are sent unsigned, and signed ones are taken as if they were not: the signature is not looked at. So does PX4
v1.14 until a key is set up; here none can be.
"""

from __future__ import annotations

from typing import Any, ClassVar

from xtdrone_control.autopilot.commander.commander import WARNING
from xtdrone_control.mavlink.link import Link
from xtdrone_control.mavlink.service import Service, Vehicle


class SigningService(Service):
    """Says once that no key can be set up."""

    MESSAGES: ClassVar[dict[str, str]] = {"SETUP_SIGNING": "_setup_signing"}

    def __init__(self, vehicle: Vehicle) -> None:
        """Serve ``vehicle``."""
        super().__init__(vehicle)
        self._said = False

    def _setup_signing(self, _link: Link, _m: Any) -> None:
        if not self._said:
            self._said = True
            self.vehicle.commander.say(WARNING, "MAVLink signing is not supported")
