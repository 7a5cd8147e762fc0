"""FOLLOW_TARGET: position of the target of AUTO.FOLLOW_TARGET, reported by ground stations."""

from __future__ import annotations

from typing import Any, ClassVar

from xtdrone_control.mavlink.client_link import Link
from xtdrone_control.mavlink.service_base import Service


class FollowService(Service):
    """Passes target reports to the navigator.

    As in PX4 v1.14, latitude, longitude, altitude and velocity are used regardless of ``est_capabilities``, which
    MAVSDK leaves without the bit of the velocity. The time of a report is its arrival; the timestamp, taken from the
    sender's clock, is ignored.
    """

    MESSAGES: ClassVar[dict[str, str]] = {"FOLLOW_TARGET": "_target"}

    def _target(self, link: Link, m: Any) -> None:
        self.vehicle.call_or_queue(lambda: self._report_target(link, m))

    def _report_target(self, link: Link, m: Any) -> None:
        north, east, down = m.vel
        position = (m.lat * 1e-7, m.lon * 1e-7, m.alt)
        try:
            self.vehicle.commander.navigator.follow_target.report(position, (north, east, down))
        except ValueError as error:
            link.warn("target", f"FOLLOW_TARGET rejected: {error}", self.vehicle.now_us)
