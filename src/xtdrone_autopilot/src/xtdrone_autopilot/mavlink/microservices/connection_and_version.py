"""The connection (HEARTBEAT, PING, TIMESYNC, SETUP_SIGNING); versions, flight and storage on request.

Frames are sent unsigned, and the signatures of received frames are ignored, as by PX4 v1.14 before a key is set up;
here none can be set up.
"""

from __future__ import annotations

from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.commander.commander import WARNING
from xtdrone_autopilot.mavlink.client_link import Link
from xtdrone_autopilot.mavlink.service_base import Service, Vehicle
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_autopilot.mavlink.wire.frame_packing import Format

_GCS_TYPE = 6  # MAV_TYPE_GCS


class ConnectionService(Service):
    """Reports ground stations to the commander, replies to PING and TIMESYNC, warns once about a key for signing."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "HEARTBEAT": "_heartbeat",
        "TIMESYNC": "_timesync",
        "PING": "_ping",
        "SETUP_SIGNING": "_setup_signing",
    }
    _warned = False

    def _heartbeat(self, _link: Link, m: Any) -> None:
        if m.type == _GCS_TYPE:
            self.vehicle.commander.gcs_heartbeat()

    def _timesync(self, link: Link, m: Any) -> None:
        if m.tc1 == 0:
            link.send_message(mavlink.MAVLink_timesync_message(self.vehicle.now_us * 1000, m.ts1))

    def _ping(self, link: Link, m: Any) -> None:
        if m.target_system == 0 and m.target_component == 0:
            link.send_message(mavlink.MAVLink_ping_message(m.time_usec, m.seq, *link.sender))

    def _setup_signing(self, _link: Link, _m: Any) -> None:
        if not self._warned:
            self._warned = True
            self.vehicle.commander.say(WARNING, "MAVLink signing is not supported")


PX4_VERSION = 0x010E03FF  # release 1.14.3, the modelled version
_MAVLINK_2, _MAVLINK_1 = 200, 100
_NO_HASH = (0,) * 8
_BOARD_VERSION = 1  # as PX4's SITL
_STORAGE_NOT_SUPPORTED = 3  # STORAGE_STATUS: size unknown

_PROTOCOL_VERSION = Format("PROTOCOL_VERSION")


class VersionService(Service):
    """Sends version, flight and storage information on request."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        vehicle.on_request.update(
            {
                MESSAGE_ID["AUTOPILOT_VERSION"]: self._autopilot_version,
                MESSAGE_ID["PROTOCOL_VERSION"]: self._protocol_version,
                MESSAGE_ID["FLIGHT_INFORMATION"]: self._flight_information,
                MESSAGE_ID["STORAGE_INFORMATION"]: self._storage_information,
            }
        )

    def _autopilot_version(self, link: Link) -> None:
        system = self.vehicle.system_id
        versions = PX4_VERSION, PX4_VERSION, 0, _BOARD_VERSION, _NO_HASH, _NO_HASH, _NO_HASH, 0, 0
        uid = [*system.to_bytes(2, "big"), *[0] * 16]
        link.send_message(mavlink.MAVLink_autopilot_version_message(self.vehicle.capabilities, *versions, system, uid))

    def _protocol_version(self, link: Link) -> None:
        values = (_MAVLINK_2, _MAVLINK_1, _MAVLINK_2, *_NO_HASH, *_NO_HASH)
        link.send_values(_PROTOCOL_VERSION, values, self.vehicle.now_us)

    def _flight_information(self, link: Link) -> None:
        commander = self.vehicle.commander
        now_ms, armed_us = self.vehicle.now_us // 1000, commander.armed_since_us
        flight = int(commander.parameters.get("COM_FLIGHT_UUID"))
        link.send_message(mavlink.MAVLink_flight_information_message(now_ms, armed_us, armed_us, flight))

    def _storage_information(self, link: Link) -> None:
        now_ms = self.vehicle.now_us // 1000
        link.send_message(
            mavlink.MAVLink_storage_information_message(now_ms, 1, 1, _STORAGE_NOT_SUPPORTED, 0.0, 0.0, 0.0, 0.0, 0.0)
        )
