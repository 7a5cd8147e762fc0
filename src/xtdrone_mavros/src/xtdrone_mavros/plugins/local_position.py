"""Local position and velocity from the estimator, in ENU."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import (
    AccelWithCovarianceStamped,
    PoseStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistStamped,
    TwistWithCovarianceStamped,
)
from nav_msgs.msg import Odometry
from tf2_msgs.msg import TFMessage

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.uas import Plugin, Uas

# Upper triangle of the 9x9 covariance of LOCAL_POSITION_NED_COV (x y z vx vy vz ax ay az), row by row: its diagonal.
_DIAGONAL = (0, 9, 17, 24, 30, 35, 39, 42, 44)


class LocalPositionPlugin(Plugin):
    """MAVROS's local_position.

    As in MAVROS, the orientation is that of the latest ATTITUDE_QUATERNION, ``velocity_local`` has the body's frame_id
    although its vectors are ENU, and pose_cov, velocity_body_cov and accel exist only for autopilots that send
    LOCAL_POSITION_NED_COV. Messages with an orientation are published from the first attitude on.
    """

    name = "local_position"

    def __init__(self, uas: Uas) -> None:
        """Advertise the topics."""
        super().__init__(uas)
        get = uas.params.get
        frame = get("local_position/frame_id", "map")
        body = get("local_position/tf/child_frame_id", "base_link")
        send_tf = get("local_position/tf/send", False)

        self._pose = uas.topic("local_position/pose", PoseStamped())
        self._pose_cov = uas.topic("local_position/pose_cov", PoseWithCovarianceStamped())
        self._velocity_local = uas.topic("local_position/velocity_local", TwistStamped())
        self._velocity_body = uas.topic("local_position/velocity_body", TwistStamped())
        self._velocity_cov = uas.topic("local_position/velocity_body_cov", TwistWithCovarianceStamped())
        self._accel = uas.topic("local_position/accel", AccelWithCovarianceStamped())
        self._odom = uas.topic("local_position/odom", Odometry(child_frame_id=body))
        for topic in (self._pose, self._pose_cov, self._accel, self._odom):
            topic.message.header.frame_id = frame
        for topic in (self._velocity_local, self._velocity_body, self._velocity_cov):
            topic.message.header.frame_id = body

        plain = [self._pose, self._velocity_local, self._velocity_body, self._odom]
        self._tf = None
        if send_tf:
            transform = TransformStamped(child_frame_id=body)
            transform.header.frame_id = get("local_position/tf/frame_id", "map")
            self._tf = uas.topic("/tf", TFMessage([transform]))
            plain.append(self._tf)
        with_covariance = (self._pose_cov, self._velocity_cov, self._accel)
        self.messages = {
            "LOCAL_POSITION_NED": Feed(self._on_position, *plain),
            "LOCAL_POSITION_NED_COV": Feed(self._on_position_cov, *with_covariance),
            "ATTITUDE_QUATERNION": Feed(None, *plain, *with_covariance),
        }

    def _on_position(self, ned: Any) -> None:
        attitude = self.uas.attitude()
        if attitude is None:
            return
        q, rates = attitude
        position = frames.ned_to_enu(ned.x, ned.y, ned.z)
        velocity = frames.ned_to_enu(ned.vx, ned.vy, ned.vz)
        if self._pose.needed:
            pose = self._pose.message
            self.uas.stamp(pose.header, ned.time_boot_ms)
            _set_pose(pose.pose, position, q)
            self._pose.publish(pose)
        if self._velocity_local.needed:
            twist = self._velocity_local.message
            self.uas.stamp(twist.header, ned.time_boot_ms)
            _set_vector(twist.twist.linear, velocity)
            _set_vector(twist.twist.angular, frames.rotate(q, rates))
            self._velocity_local.publish(twist)
        if self._velocity_body.needed:
            twist = self._velocity_body.message
            self.uas.stamp(twist.header, ned.time_boot_ms)
            _set_vector(twist.twist.linear, frames.rotate_inverse(q, velocity))
            _set_vector(twist.twist.angular, rates)
            self._velocity_body.publish(twist)
        if self._odom.needed:
            odom = self._odom.message
            self.uas.stamp(odom.header, ned.time_boot_ms)
            _set_pose(odom.pose.pose, position, q)
            _set_vector(odom.twist.twist.linear, frames.rotate_inverse(q, velocity))
            _set_vector(odom.twist.twist.angular, rates)
            self._odom.publish(odom)
        if self._tf is not None and self._tf.needed:
            transform = self._tf.message.transforms[0]
            self.uas.stamp(transform.header, ned.time_boot_ms)
            _set_vector(transform.transform.translation, position)
            _set_quaternion(transform.transform.rotation, q)
            self._tf.publish(self._tf.message)

    def _on_position_cov(self, ned: Any) -> None:
        attitude = self.uas.attitude()
        if attitude is None:
            return
        q, rates = attitude
        variance = [ned.covariance[i] for i in _DIAGONAL]
        # The diagonal is (north, east, down), which maps to (y, x, z).
        pose = self._pose_cov.message
        self.uas.stamp_us(pose.header, ned.time_usec)
        _set_pose(pose.pose.pose, frames.ned_to_enu(ned.x, ned.y, ned.z), q)
        pose.pose.covariance = _covariance(variance[1], variance[0], variance[2])
        self._pose_cov.publish(pose)

        twist = self._velocity_cov.message
        self.uas.stamp_us(twist.header, ned.time_usec)
        velocity = frames.ned_to_enu(ned.vx, ned.vy, ned.vz)
        _set_vector(twist.twist.twist.linear, frames.rotate_inverse(q, velocity))
        _set_vector(twist.twist.twist.angular, rates)
        twist.twist.covariance = _covariance(variance[4], variance[3], variance[5])
        self._velocity_cov.publish(twist)

        accel = self._accel.message
        self.uas.stamp_us(accel.header, ned.time_usec)
        _set_vector(accel.accel.accel.linear, frames.ned_to_enu(ned.ax, ned.ay, ned.az))
        accel.accel.covariance = _covariance(variance[7], variance[6], variance[8])
        self._accel.publish(accel)


def _set_vector(message: Any, vector: frames.Vector) -> None:
    message.x, message.y, message.z = vector


def _set_quaternion(message: Any, q: frames.Quaternion) -> None:
    message.w, message.x, message.y, message.z = q


def _set_pose(pose: Any, position: frames.Vector, q: frames.Quaternion) -> None:
    place, orientation = pose.position, pose.orientation
    place.x, place.y, place.z = position
    orientation.w, orientation.x, orientation.y, orientation.z = q


def _covariance(x: float, y: float, z: float) -> list[float]:
    """Return a 6x6 covariance, row by row, with these variances; all others are unknown (0, as in MAVROS)."""
    matrix = [0.0] * 36
    matrix[0], matrix[7], matrix[14] = x, y, z
    return matrix
