"""RC channels, and servo and motor outputs."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import OverrideRCIn, RCIn, RCOut
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas

_SERVOS = 16  # outputs in one SERVO_OUTPUT_RAW, MAVLink 2
_CHANNELS = 18  # channels in one RC_CHANNELS or RC_CHANNELS_OVERRIDE


class RcIoPlugin(Plugin):
    """MAVROS's rc_io. Channels are pulse widths in us.

    ``rc/override`` replaces a radio: the autopilot uses it according to COM_RC_IN_MODE, with the calibration and
    mapping of its RC parameters, and returns it as ``rc/in``. ``rc/in`` is RC_CHANNELS, as PX4 has no RC_CHANNELS_RAW.
    """

    name = "rc_io"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topics and subscribe."""
        super().__init__(uas)
        self._in = uas.topic("rc/in", RCIn())
        self._out = uas.topic("rc/out", RCOut())
        self._outputs: list[int] = []
        self.messages = {
            "RC_CHANNELS": Feed(self._on_channels, self._in),
            "SERVO_OUTPUT_RAW": Feed(self._on_servos, self._out),
        }
        uas.subscribe("rc/override", OverrideRCIn, self._override)

    def _on_channels(self, radio: Any) -> None:
        if radio.chancount > _CHANNELS:
            self.uas.warn("rc/in", "rc/in: the radio has %d channels, %d are published", radio.chancount, _CHANNELS)
        message = self._in.message
        self.uas.stamp(message.header, radio.time_boot_ms)
        message.rssi = radio.rssi
        count = min(radio.chancount, _CHANNELS)
        message.channels = [getattr(radio, f"chan{i}_raw") for i in range(1, count + 1)]
        self._in.publish(message)

    def _on_servos(self, servos: Any) -> None:
        first = servos.port * _SERVOS
        if len(self._outputs) < first + _SERVOS:
            self._outputs += [0] * (first + _SERVOS - len(self._outputs))
        values = [getattr(servos, f"servo{i}_raw") for i in range(1, _SERVOS + 1)]
        self._outputs[first : first + _SERVOS] = values
        message = self._out.message
        self.uas.stamp_us(message.header, servos.time_usec)
        message.channels = self._outputs
        self._out.publish(message)

    def _override(self, message: OverrideRCIn) -> None:
        self.uas.link.send(mavlink.MAVLink_rc_channels_override_message(*self.uas.target, *message.channels))
