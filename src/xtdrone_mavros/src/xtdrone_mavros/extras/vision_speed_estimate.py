"""Velocities from a vision system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import TwistStamped, TwistWithCovarianceStamped, Vector3Stamped

from xtdrone_common import frames
from xtdrone_mavros.relayed_messages import In
from xtdrone_mavros.uas import Plugin, Uas

_NO_COVARIANCE = [0.0] * 36
_LINEAR = [6 * row + column for row in range(3) for column in range(3)]  # of a 6x6 matrix


def _fields(velocity: Any, covariance: Sequence[float]) -> dict[str, Any]:
    """Convert an ENU velocity (m/s) with a 6x6 covariance, row by row, to the fields of VISION_SPEED_ESTIMATE."""
    ned = frames.enu_to_ned(velocity.x, velocity.y, velocity.z)
    turned = frames.covariance_enu_to_ned(covariance)
    return {**dict(zip("xyz", ned, strict=True)), "covariance": [turned[i] for i in _LINEAR]}


_ROWS = {
    "speed_twist_cov": (TwistWithCovarianceStamped, lambda m: _fields(m.twist.twist.linear, m.twist.covariance)),
    "speed_twist": (TwistStamped, lambda m: _fields(m.twist.linear, _NO_COVARIANCE)),
    "speed_vector": (Vector3Stamped, lambda m: _fields(m.vector, _NO_COVARIANCE)),
}


class VisionSpeedPlugin(Plugin):
    """MAVROS's vision_speed_estimate: ENU velocities to VISION_SPEED_ESTIMATE, which PX4 v1.14 does not read.

    The topic is ``vision_speed/speed_twist_cov``; ``speed_twist`` if ``vision_speed/twist_cov`` is false,
    ``speed_vector`` if ``vision_speed/listen_twist`` is true.
    """

    name = "vision_speed_estimate"

    def __init__(self, uas: Uas) -> None:
        """Subscribe."""
        super().__init__(uas)
        twist = "speed_twist_cov" if uas.params.get("vision_speed/twist_cov", True) else "speed_twist"
        topic = twist if uas.params.get("vision_speed/listen_twist", True) else "speed_vector"
        kind, convert = _ROWS[topic]
        row = In(f"vision_speed/{topic}", kind, "VISION_SPEED_ESTIMATE", convert, free=("covariance",))
        uas.subscribe(row.topic, row.kind, lambda m: row.forward(uas, m))
