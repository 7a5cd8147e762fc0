"""Poses from a vision system such as a SLAM or VIO node."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common import frames
from xtdrone_mavros.uas import Plugin, Uas

_NO_COVARIANCE = [0.0] * 21  # as in MAVROS: the autopilot then uses its minimum noise


class VisionPosePlugin(Plugin):
    """MAVROS's vision_pose_estimate without its tf listener: sends ENU poses as VISION_POSITION_ESTIMATE."""

    name = "vision_pose_estimate"

    def __init__(self, uas: Uas) -> None:
        """Subscribe."""
        super().__init__(uas)
        uas.subscribe("vision_pose/pose", PoseStamped, self._pose)
        uas.subscribe("vision_pose/pose_cov", PoseWithCovarianceStamped, self._pose_with_covariance)

    def _pose(self, message: PoseStamped) -> None:
        self._send(message.header, message.pose, _NO_COVARIANCE)

    def _pose_with_covariance(self, message: PoseWithCovarianceStamped) -> None:
        covariance = frames.upper_triangle(frames.covariance_enu_to_ned(message.pose.covariance))
        self._send(message.header, message.pose.pose, covariance)

    def _send(self, header: Any, pose: Any, covariance: Sequence[float]) -> None:
        p, q = pose.position, pose.orientation
        attitude = frames.attitude_enu_to_ned(q.w, q.x, q.y, q.z)
        self.uas.link.send(
            mavlink.MAVLink_vision_position_estimate_message(
                header.stamp.to_nsec() // 1000,
                *frames.enu_to_ned(p.x, p.y, p.z),
                *frames.rpy_from_quaternion(attitude),
                covariance,
            )
        )
