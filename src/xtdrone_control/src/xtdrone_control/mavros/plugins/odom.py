"""Odometry, both ways."""

from __future__ import annotations

from typing import Any

from nav_msgs.msg import Odometry
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control import frames
from xtdrone_control.mavros.plugin import Feed, Plugin
from xtdrone_control.mavros.uas import Uas

_LOCAL_NED, _BODY_FRD, _LOCAL_FRD = 1, 12, 20  # MAV_FRAME
_ESTIMATOR_VISION = 2  # MAV_ESTIMATOR_TYPE


class OdometryPlugin(Plugin):
    """MAVROS's odometry: ``odometry/in`` is the autopilot's ODOMETRY, ``odometry/out`` goes to it.

    Poses are ENU, twists FLU in the child's frame. MAVROS asks tf how ``odom`` and its children lie; here ``odom`` is
    ENU and its child FLU, as MAVROS's own static transforms have them. What goes out is declared MAV_FRAME_LOCAL_FRD
    and MAV_FRAME_BODY_FRD, as in MAVROS: the autopilot does not take its x for north.
    """

    name = "odometry"

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe."""
        super().__init__(uas)
        parent = uas.params.get("odometry/fcu/odom_parent_id_des", "map")
        child = uas.params.get("odometry/fcu/odom_child_id_des", "base_link")
        self._in = uas.topic("odometry/in", Odometry(child_frame_id=child))
        self._in.message.header.frame_id = parent
        self.messages = {"ODOMETRY": Feed(self._on_odometry, self._in)}
        uas.subscribe("odometry/out", Odometry, self._out)

    def _on_odometry(self, m: Any) -> None:
        if m.frame_id != _LOCAL_NED or m.child_frame_id != _BODY_FRD:
            self.uas.warn("odometry/in", "ODOMETRY in frames %d, %d is not published", m.frame_id, m.child_frame_id)
            return
        odometry = self._in.message
        self.uas.stamp_us(odometry.header, m.time_usec)
        pose, twist = odometry.pose.pose, odometry.twist.twist
        p, q = pose.position, pose.orientation
        p.x, p.y, p.z = frames.ned_to_enu(m.x, m.y, m.z)
        q.w, q.x, q.y, q.z = frames.attitude_ned_to_enu(*m.q)
        v, w = twist.linear, twist.angular
        v.x, v.y, v.z = frames.frd_to_flu(m.vx, m.vy, m.vz)
        w.x, w.y, w.z = frames.frd_to_flu(m.rollspeed, m.pitchspeed, m.yawspeed)
        odometry.pose.covariance = frames.covariance_enu_to_ned(frames.from_upper_triangle(m.pose_covariance))
        odometry.twist.covariance = frames.covariance_flu_to_frd(frames.from_upper_triangle(m.velocity_covariance))
        self._in.publish(odometry)

    def _out(self, odometry: Odometry) -> None:
        pose, twist = odometry.pose.pose, odometry.twist.twist
        p, q, v, w = pose.position, pose.orientation, twist.linear, twist.angular
        self.uas.link.send(
            mavlink.MAVLink_odometry_message(
                odometry.header.stamp.to_nsec() // 1000,
                _LOCAL_FRD,
                _BODY_FRD,
                *frames.enu_to_ned(p.x, p.y, p.z),
                frames.attitude_enu_to_ned(q.w, q.x, q.y, q.z),
                *frames.flu_to_frd(v.x, v.y, v.z),
                *frames.flu_to_frd(w.x, w.y, w.z),
                frames.upper_triangle(frames.covariance_enu_to_ned(odometry.pose.covariance)),
                frames.upper_triangle(frames.covariance_flu_to_frd(odometry.twist.covariance)),
                0,
                _ESTIMATOR_VISION,
                0,
            )
        )
