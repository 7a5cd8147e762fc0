"""The target that is followed in AUTO.FOLLOW_TARGET, as ground stations report it."""

from __future__ import annotations

from typing import Any, ClassVar

from xtdrone_control.mavlink.link import Link
from xtdrone_control.mavlink.service import Service


class FollowService(Service):
    """Hands reports of a target to the navigator.

    Of FOLLOW_TARGET latitude, longitude, altitude and velocity are read whatever ``est_capabilities`` says, as in PX4
    v1.14: MAVSDK fills in a velocity without saying so. A report counts from when it comes; its time stamp, of the
    sender's clock, is not used.
    """

    MESSAGES: ClassVar[dict[str, str]] = {"FOLLOW_TARGET": "_target"}

    def _target(self, link: Link, m: Any) -> None:
        self.vehicle.in_turn(lambda: self._take(link, m))

    def _take(self, link: Link, m: Any) -> None:
        north, east, down = m.vel
        place = (m.lat * 1e-7, m.lon * 1e-7, m.alt)
        try:
            self.vehicle.commander.navigator.follow_target.report(place, (north, east, down))
        except ValueError as error:
            link.warn("target", f"FOLLOW_TARGET rejected: {error}", self.vehicle.now_us)
