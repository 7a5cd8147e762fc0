"""Manual control by sticks, to the autopilot and from it."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import ManualControl
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.link.ros_values_to_mavlink import whole
from xtdrone_mavros.uas import Plugin, Uas

_AXES = "xyzr"  # forward, right, up, clockwise
_SCALE = 1000.0


class ManualControlPlugin(Plugin):
    """MAVROS's manual_control, with its two scales: ``send`` has MAVLink's numbers, ``control`` a thousandth of them.

    ``send`` acts as a joystick: x, y and r are -1000..1000, z is 0..1000 with its centre at 500; COM_RC_IN_MODE decides
    how the autopilot uses it. ``control`` has the stick positions that the autopilot follows, from any source.
    """

    name = "manual_control"

    def __init__(self, uas: Uas) -> None:
        """Subscribe and advertise."""
        super().__init__(uas)
        self._control = uas.topic("manual_control/control", ManualControl())
        self.messages = {"MANUAL_CONTROL": Feed(self._on_control, self._control)}
        uas.subscribe("manual_control/send", ManualControl, self._send)

    def _on_control(self, control: Any) -> None:
        message = self._control.message
        self.uas.stamp_now(message.header)
        for axis in _AXES:
            setattr(message, axis, getattr(control, axis) / _SCALE)
        message.buttons = control.buttons
        self._control.publish(message)

    def _send(self, message: ManualControl) -> None:
        axes = [whole(getattr(message, axis)) for axis in _AXES]
        self.uas.link.send(mavlink.MAVLink_manual_control_message(self.uas.target[0], *axes, message.buttons))
