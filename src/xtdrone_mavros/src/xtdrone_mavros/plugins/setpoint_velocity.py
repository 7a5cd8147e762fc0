"""Velocity setpoints as twists."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import Twist, TwistStamped

from xtdrone_mavros.lib.mav_frames import MavFrame
from xtdrone_mavros.lib.setpoint_messages import ONLY_VELOCITY_YAW_RATE, position_target
from xtdrone_mavros.uas import Plugin, Uas


class SetpointVelocityPlugin(Plugin):
    """MAVROS's setpoint_velocity: linear velocity and yaw rate."""

    name = "setpoint_velocity"

    def __init__(self, uas: Uas) -> None:
        """Subscribe."""
        super().__init__(uas)
        self._frame = MavFrame(uas, self.name)
        uas.subscribe_setpoint("setpoint_velocity/cmd_vel", TwistStamped, self._on_stamped)
        uas.subscribe_setpoint("setpoint_velocity/cmd_vel_unstamped", Twist, self._on_unstamped)

    def _on_stamped(self, twist: TwistStamped) -> None:
        self._send("setpoint_velocity/cmd_vel", twist.twist, self.uas.boot_ms(twist.header))

    def _on_unstamped(self, twist: Twist) -> None:
        self._send("setpoint_velocity/cmd_vel_unstamped", twist, self.uas.boot_ms())

    def _send(self, topic: str, twist: Any, time_boot_ms: int) -> None:
        v = twist.linear
        fields = [(f"linear.{axis}", getattr(v, axis)) for axis in "xyz"] + [("angular.z", twist.angular.z)]
        if not self.uas.finite(topic, fields):
            return
        self.uas.link.send(
            position_target(
                self.uas,
                time_boot_ms,
                self._frame.value,
                ONLY_VELOCITY_YAW_RATE,
                velocity=(v.x, v.y, v.z),
                yaw_rate=twist.angular.z,
            )
        )
