"""Position set-points as poses."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped

from xtdrone_control import frames
from xtdrone_control.mavros.mav_frames import MavFrame
from xtdrone_control.mavros.plugin import Plugin
from xtdrone_control.mavros.setpoints import ONLY_POSITION_YAW, position_target
from xtdrone_control.mavros.uas import Uas


class SetpointPositionPlugin(Plugin):
    """The local half of MAVROS's setpoint_position: position and the yaw of the orientation."""

    name = "setpoint_position"

    def __init__(self, uas: Uas) -> None:
        """Subscribe."""
        super().__init__(uas)
        self._frame = MavFrame(uas, self.name)
        uas.subscribe("setpoint_position/local", PoseStamped, self._local)

    def _local(self, pose: PoseStamped) -> None:
        p, q = pose.pose.position, pose.pose.orientation
        fields = [(f"pose.position.{axis}", getattr(p, axis)) for axis in "xyz"]
        fields += [(f"pose.orientation.{axis}", getattr(q, axis)) for axis in "xyzw"]
        if not self.uas.finite("setpoint_position/local", fields):
            return
        yaw = frames.yaw_from_quaternion((q.w, q.x, q.y, q.z))
        self.uas.link.send(
            position_target(
                self.uas,
                self.uas.boot_ms(pose.header),
                self._frame.value,
                ONLY_POSITION_YAW,
                position=(p.x, p.y, p.z),
                yaw=yaw,
            )
        )
