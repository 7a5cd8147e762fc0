"""Acceleration setpoints as vectors."""

from __future__ import annotations

from geometry_msgs.msg import Vector3Stamped
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.lib.setpoint_messages import FORCE, ONLY_ACCELERATION, position_target, vector_fields, xyz
from xtdrone_mavros.uas import Plugin, Uas

_TOPIC = "setpoint_accel/accel"


class SetpointAccelPlugin(Plugin):
    """MAVROS's setpoint_accel: an acceleration (m/s^2, ENU), or a force (N) with ``setpoint_accel/send_force``.

    PX4 rejects forces.
    """

    name = "setpoint_accel"

    def __init__(self, uas: Uas) -> None:
        """Subscribe."""
        super().__init__(uas)
        force = uas.params.get("setpoint_accel/send_force", False)
        self._mask = ONLY_ACCELERATION | FORCE if force else ONLY_ACCELERATION
        uas.subscribe_setpoint(_TOPIC, Vector3Stamped, self._accel)

    def _accel(self, message: Vector3Stamped) -> None:
        if not self.uas.finite(_TOPIC, vector_fields("vector", message.vector)):
            return
        time_boot_ms = self.uas.boot_ms(message.header)
        self.uas.link.send(
            position_target(
                self.uas, time_boot_ms, mavlink.MAV_FRAME_LOCAL_NED, self._mask, acceleration=xyz(message.vector)
            )
        )
