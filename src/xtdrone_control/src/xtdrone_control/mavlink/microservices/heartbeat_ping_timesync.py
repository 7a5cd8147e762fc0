"""Received HEARTBEAT, PING and TIMESYNC."""

from __future__ import annotations

from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.mavlink.client_link import Link
from xtdrone_control.mavlink.service_base import Service

_GCS_TYPE = 6  # MAV_TYPE_GCS


class HeartbeatService(Service):
    """Reports ground stations to the commander, and replies to PING and TIMESYNC."""

    MESSAGES: ClassVar[dict[str, str]] = {"HEARTBEAT": "_heartbeat", "TIMESYNC": "_timesync", "PING": "_ping"}

    def _heartbeat(self, _link: Link, m: Any) -> None:
        if m.type == _GCS_TYPE:
            self.vehicle.commander.gcs_heartbeat()

    def _timesync(self, link: Link, m: Any) -> None:
        if m.tc1 == 0:
            link.send_message(mavlink.MAVLink_timesync_message(self.vehicle.now_us * 1000, m.ts1))

    def _ping(self, link: Link, m: Any) -> None:
        if m.target_system == 0 and m.target_component == 0:
            link.send_message(mavlink.MAVLink_ping_message(m.time_usec, m.seq, *link.sender))
