"""Corrections for the autopilot's GPS receiver, and its baseline to the base station."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import RTCM, RTKBaseline
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.link.ros_values_to_mavlink import FieldError
from xtdrone_mavros.relayed_messages import Out, Relay
from xtdrone_mavros.uas import Uas

_FRAGMENT = 180  # bytes of a GPS_RTCM_DATA
_FRAGMENTS = 4
_FRAGMENTED = 1  # flag; the fragment number (2 bits) and the sequence number (5 bits) follow


class GpsRtkPlugin(Relay):
    """MAVROS's gps_rtk."""

    name = "gps_rtk"
    outs = (Out("GPS_RTK", "gps_rtk/rtk_baseline", RTKBaseline, latch=True),)

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe."""
        super().__init__(uas)
        uas.subscribe("gps_rtk/send_rtcm", RTCM, self._send)

    def _send(self, rtcm: Any) -> None:
        """Send the corrections, split into several messages if necessary."""
        data, most = bytes(rtcm.data), _FRAGMENT * _FRAGMENTS
        if len(data) > most:
            raise FieldError("data", f"{len(data)} bytes", f"at most {most}")
        sequence = (rtcm.header.seq & 0x1F) << 3
        for number, start in enumerate(range(0, max(len(data), 1), _FRAGMENT)):
            part = data[start : start + _FRAGMENT]
            flags = sequence | (_FRAGMENTED | number << 1 if len(data) > _FRAGMENT else 0)
            padded = list(part.ljust(_FRAGMENT, b"\0"))
            self.uas.link.send(mavlink.MAVLink_gps_rtcm_data_message(flags, len(part), padded))
