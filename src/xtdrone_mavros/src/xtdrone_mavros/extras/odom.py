"""Odometry from the autopilot and to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nav_msgs.msg import Odometry
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas

# MAV_FRAME
_LOCAL_NED, _BODY_NED, _BODY_FRD, _LOCAL_FRD = 1, 8, 12, 20
_PARENTS = (_LOCAL_NED, _LOCAL_FRD)
_BODIES = (_BODY_FRD, _BODY_NED)
_ESTIMATOR_VISION = 2  # MAV_ESTIMATOR_TYPE


class OdometryPlugin(Plugin):
    """MAVROS's odometry: ``odometry/in`` is the autopilot's ODOMETRY, ``odometry/out`` is sent to it.

    Poses are ENU, twists FLU in the child frame. MAVROS looks up ``odom`` and its children in tf; here ``odom`` is ENU
    and its child FLU, as in MAVROS's static transforms. As in MAVROS, outgoing messages are declared
    MAV_FRAME_LOCAL_FRD and MAV_FRAME_BODY_FRD, so the autopilot does not interpret x as north.

    The velocity in PX4 v1.14's ODOMETRY is in LOCAL_NED. MAVROS interprets every velocity as a body velocity; here a
    velocity in a local frame is rotated into the body frame. Unknown (NaN) parts of a covariance are 0.
    """

    name = "odom"

    def __init__(self, uas: Uas) -> None:
        """Advertise and subscribe."""
        super().__init__(uas)
        child = uas.params.get("odometry/fcu/odom_child_id_des", "base_link")
        self._in = uas.topic("odometry/in", Odometry(child_frame_id=child))
        self._in.message.header.frame_id = uas.params.get("odometry/fcu/map_id_des", "map")
        self.messages = {"ODOMETRY": Feed(self._on_odometry, self._in)}
        uas.subscribe("odometry/out", Odometry, self._out)

    def _on_odometry(self, m: Any) -> None:
        if m.frame_id not in _PARENTS or m.child_frame_id not in (*_PARENTS, *_BODIES):
            self.uas.warn("odometry/in", "ODOMETRY in frames %d, %d is not published", m.frame_id, m.child_frame_id)
            return
        odometry = self._in.message
        self.uas.stamp_us(odometry.header, m.time_usec)
        pose, twist = odometry.pose.pose, odometry.twist.twist
        p, q = pose.position, pose.orientation
        p.x, p.y, p.z = frames.ned_to_enu(m.x, m.y, m.z)
        q.w, q.x, q.y, q.z = frames.attitude_ned_to_enu(*m.q)
        velocity, covariance = (m.vx, m.vy, m.vz), _matrix(m.velocity_covariance)
        if m.child_frame_id not in _BODIES:
            to_body = m.q[0], -m.q[1], -m.q[2], -m.q[3]
            velocity, covariance = frames.rotate(to_body, velocity), _rotate_covariance(to_body, covariance)
        v, w = twist.linear, twist.angular
        v.x, v.y, v.z = frames.frd_to_flu(*velocity)
        w.x, w.y, w.z = frames.frd_to_flu(m.rollspeed, m.pitchspeed, m.yawspeed)
        odometry.pose.covariance = frames.covariance_enu_to_ned(_matrix(m.pose_covariance))
        odometry.twist.covariance = frames.covariance_flu_to_frd(covariance)
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


def _matrix(upper: Sequence[float]) -> list[float]:
    """Return a MAVLink covariance as a 6x6 matrix, row by row."""
    return frames.from_upper_triangle([value if value == value else 0.0 for value in upper])


def _rotate_covariance(q: frames.Quaternion, covariance: list[float]) -> list[float]:
    """Return a 6x6 covariance, row by row, with its first vector rotated by ``q``."""
    columns = [frames.rotate(q, (covariance[i], covariance[6 + i], covariance[12 + i])) for i in range(6)]
    rows = [[column[i] for column in columns] for i in range(3)]
    turned = [[*frames.rotate(q, (row[0], row[1], row[2])), *row[3:]] for row in rows]
    below = [[turned[0][i], turned[1][i], turned[2][i], *covariance[6 * i + 3 : 6 * i + 6]] for i in range(3, 6)]
    return [value for row in (*turned, *below) for value in row]
