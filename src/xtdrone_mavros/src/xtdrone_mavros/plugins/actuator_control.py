"""Controls that bypass the attitude controller, from the autopilot and to it."""

from __future__ import annotations

from typing import Any

from mavros_msgs.msg import ActuatorControl
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas

_TOPIC = "actuator_control"


class ActuatorControlPlugin(Plugin):
    """MAVROS's actuator_control: values are passed unchanged, in the autopilot's axes (FRD).

    PX4 rejects ``actuator_control`` while it runs in lockstep with a simulator, and so does the built-in autopilot.
    ``target_actuator_control`` has the torque and thrust requested from the control allocator, as group 0.
    """

    name = "actuator_control"

    def __init__(self, uas: Uas) -> None:
        """Subscribe and advertise."""
        super().__init__(uas)
        self._target = uas.topic("target_actuator_control", ActuatorControl())
        self.messages = {"ACTUATOR_CONTROL_TARGET": Feed(self._on_target, self._target)}
        uas.subscribe(_TOPIC, ActuatorControl, self._control)

    def _on_target(self, target: Any) -> None:
        message = self._target.message
        self.uas.stamp_us(message.header, target.time_usec)
        message.group_mix = target.group_mlx
        message.controls = target.controls
        self._target.publish(message)

    def _control(self, message: ActuatorControl) -> None:
        controls = list(message.controls)
        if not self.uas.finite(_TOPIC, [(f"controls[{i}]", value) for i, value in enumerate(controls)]):
            return
        time_us = message.header.stamp.to_nsec() // 1000
        self.uas.link.send(
            mavlink.MAVLink_set_actuator_control_target_message(time_us, message.group_mix, *self.uas.target, controls)
        )
