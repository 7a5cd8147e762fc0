"""Component metadata: definitions of the events and parameters for ground stations.

Source: mavlink.io, "Component Metadata Protocol". COMPONENT_METADATA, and the older COMPONENT_INFORMATION, give the URI
of a file served by MAVLink FTP, which lists the other files. As in PX4 they are in ``/etc/extras``, but uncompressed.
"""

from __future__ import annotations

import zlib
from functools import cached_property

from xtdrone_control.autopilot.parameters import metadata
from xtdrone_control.mavlink.client_link import Link
from xtdrone_control.mavlink.service_base import Service, Vehicle
from xtdrone_control.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_control.mavlink.wire.frame_packing import Format

_METADATA, _INFORMATION = Format("COMPONENT_METADATA"), Format("COMPONENT_INFORMATION")
_FOLDER = "/etc/extras"
_GENERAL = f"{_FOLDER}/component_general.json"
_PARAMETERS = f"{_FOLDER}/parameters.json"
_EVENTS = f"{_FOLDER}/all_events.json"
_FLIP = 0xFFFFFFFF


def checksum(data: bytes) -> int:
    """Return MAVLink's CRC32: it starts from 0 and does not invert; zlib inverts before and after."""
    return zlib.crc32(data, _FLIP) ^ _FLIP


class MetadataService(Service):
    """Serves the metadata files and sends their URI."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Register the service with ``vehicle``."""
        super().__init__(vehicle)
        vehicle.files.update(
            {
                _GENERAL: lambda: self._general,
                _PARAMETERS: lambda: self._parameters,
                _EVENTS: metadata.event_definitions,
            }
        )
        vehicle.on_request.update(
            {
                MESSAGE_ID["COMPONENT_METADATA"]: self._component_metadata,
                MESSAGE_ID["COMPONENT_INFORMATION"]: self._component_information,
            }
        )

    @cached_property
    def _parameters(self) -> bytes:
        return metadata.parameter_definitions(self.vehicle.commander.parameters)

    @cached_property
    def _general(self) -> bytes:
        files = {
            metadata.PARAMETER: (_PARAMETERS, self._parameters),
            metadata.EVENTS: (_EVENTS, metadata.event_definitions()),
        }
        return metadata.general({kind: (f"mftp://{path}", checksum(data)) for kind, (path, data) in files.items()})

    def _component_metadata(self, link: Link) -> None:
        values = (self.vehicle.now_us // 1000, checksum(self._general), f"mftp://{_GENERAL}".encode())
        link.send_values(_METADATA, values, self.vehicle.now_us)

    def _component_information(self, link: Link) -> None:
        values = (self.vehicle.now_us // 1000, checksum(self._general), 0, f"mftp://{_GENERAL}".encode(), b"")
        link.send_values(_INFORMATION, values, self.vehicle.now_us)
