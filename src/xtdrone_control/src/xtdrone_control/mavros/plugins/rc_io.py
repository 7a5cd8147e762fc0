"""Servo and motor outputs."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import RCOut

from xtdrone_control.mavros.plugin import Feed, Plugin
from xtdrone_control.mavros.uas import Uas

_CHANNELS = 16  # of one SERVO_OUTPUT_RAW, MAVLink 2


class RcIoPlugin(Plugin):
    """The output half of MAVROS's rc_io."""

    name = "rc_io"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topic."""
        super().__init__(uas)
        self._out = uas.topic("rc/out", RCOut())
        self._channels: list[int] = []
        self.messages = {"SERVO_OUTPUT_RAW": Feed(self._on_servos, self._out)}

    def _on_servos(self, servos: Any) -> None:
        first = servos.port * _CHANNELS
        if len(self._channels) < first + _CHANNELS:
            self._channels += [0] * (first + _CHANNELS - len(self._channels))
        values = [getattr(servos, f"servo{i}_raw") for i in range(1, _CHANNELS + 1)]
        self._channels[first : first + _CHANNELS] = values
        message = self._out.message
        self.uas.stamp_us(message.header, servos.time_usec)
        message.channels = self._channels
        self._out.publish(message)
