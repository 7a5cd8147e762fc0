"""Poses from a motion-capture system."""

from __future__ import annotations

from geometry_msgs.msg import PoseStamped
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common import frames
from xtdrone_mavros.uas import Plugin, Uas

_NO_COVARIANCE = [0.0] * 21


class MocapPlugin(Plugin):
    """The pose part of MAVROS's mocap_pose_estimate: ENU poses to ATT_POS_MOCAP."""

    name = "mocap_pose_estimate"

    def __init__(self, uas: Uas) -> None:
        """Subscribe, unless ``mocap/use_pose`` is false."""
        super().__init__(uas)
        if uas.params.get("mocap/use_pose", True):
            uas.subscribe("mocap/pose", PoseStamped, self._pose)

    def _pose(self, message: PoseStamped) -> None:
        p, q = message.pose.position, message.pose.orientation
        self.uas.link.send(
            mavlink.MAVLink_att_pos_mocap_message(
                message.header.stamp.to_nsec() // 1000,
                frames.attitude_enu_to_ned(q.w, q.x, q.y, q.z),
                *frames.enu_to_ned(p.x, p.y, p.z),
                _NO_COVARIANCE,
            )
        )
