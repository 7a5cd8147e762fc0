"""The parameter protocol: list, read, write, and the hash of all."""

from __future__ import annotations

import struct
from typing import Any, ClassVar

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.autopilot.parameters import FLOAT, INT32, NAMES, ParameterError, describe
from xtdrone_control.mavlink.link import Link
from xtdrone_control.mavlink.service import Service, Vehicle

_HASH_NAME = "_HASH_CHECK"
_HASH_TYPE = 5  # MAV_PARAM_TYPE_UINT32


class ParameterService(Service):
    """Lists, reads and writes the vehicle's parameters."""

    MESSAGES: ClassVar[dict[str, str]] = {
        "PARAM_REQUEST_LIST": "_param_request_list",
        "PARAM_REQUEST_READ": "_param_request_read",
        "PARAM_SET": "_param_set",
    }

    def __init__(self, vehicle: Vehicle) -> None:
        """Serve ``vehicle``."""
        super().__init__(vehicle)
        self._parameters = vehicle.commander.parameters

    def _param_request_list(self, link: Link, _m: Any) -> None:
        for name in NAMES:
            self._send_parameter(link, name)
        self._send_hash(link)

    def _param_request_read(self, link: Link, m: Any) -> None:
        if m.param_index < 0:
            name = m.param_id
        elif m.param_index < len(NAMES):
            name = NAMES[m.param_index]
        else:
            return
        if name == _HASH_NAME:
            self._send_hash(link)
        elif name in NAMES:
            self._send_parameter(link, name)

    def _param_set(self, link: Link, m: Any) -> None:
        value = m.param_value
        if m.param_type == INT32:
            (value,) = struct.unpack("<i", struct.pack("<f", value))
        try:
            self._parameters.set(m.param_id, value, m.param_type)
        except ParameterError as error:
            # PX4 answers nothing; the log says why
            link.warn("parameter", f"parameter not set: {error}", self.vehicle.now_us)
            return
        self._send_parameter(link, m.param_id)

    def _send_parameter(self, link: Link, name: str) -> None:
        value: float = self._parameters.get(name)
        kind = FLOAT
        if describe(name).type == INT32:
            kind = INT32
            (value,) = struct.unpack("<f", struct.pack("<i", int(value)))
        link.send_message(
            mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(NAMES), NAMES.index(name))
        )

    def _send_hash(self, link: Link) -> None:
        (value,) = struct.unpack("<f", struct.pack("<I", self._parameters.hash()))
        link.send_message(
            mavlink.MAVLink_param_value_message(_HASH_NAME.encode(), value, _HASH_TYPE, len(NAMES), 0xFFFF)
        )
