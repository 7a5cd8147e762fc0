"""A trajectory, sent point by point at the points' times."""

from __future__ import annotations

from threading import Lock
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from std_srvs.srv import Trigger, TriggerResponse
from trajectory_msgs.msg import MultiDOFJointTrajectory, MultiDOFJointTrajectoryPoint

from xtdrone_common import frames
from xtdrone_mavros.lib.mav_frames import MavFrame
from xtdrone_mavros.lib.setpoint_messages import position_target, set_xyz, vector_fields, xyz
from xtdrone_mavros.uas import Plugin, Uas

_TOPIC = "setpoint_trajectory/local"
_EVERY_STEP = 0.0  # s
_ZERO = (0.0, 0.0, 0.0)
# bits of the mask for fields that a point lacks
_NO_TRANSFORM, _NO_VELOCITY, _NO_ACCELERATION = 1 << 10 | 7, 1 << 11 | 7 << 3, 7 << 6


class SetpointTrajectoryPlugin(Plugin):
    """MAVROS's setpoint_trajectory: the first joint of each point is the vehicle.

    A point is sent once, when its ``time_from_start`` has passed since the trajectory was received; if several are due
    in one step of the node, only the last is sent. A new trajectory replaces the old one. Quantities that a point lacks
    (transforms, velocities, accelerations) are masked out. Vectors are ENU, or FLU in the body frames of ``mav_frame``;
    the yaw rate is about the upward axis.

    MAVROS waits for each point's ``time_from_start`` after the previous point, although ROS defines it from the start
    of the trajectory, and negates the yaw rate; here both follow ROS.
    """

    name = "setpoint_trajectory"

    def __init__(self, uas: Uas) -> None:
        """Subscribe, advertise and offer the services."""
        super().__init__(uas)
        self._frame = MavFrame(uas, self.name)
        self._desired = uas.topic("setpoint_trajectory/desired", Path())
        self._desired.message.header.frame_id = uas.params.get("setpoint_trajectory/frame_id", "map")
        self._points: list[MultiDOFJointTrajectoryPoint] = []  # pending
        self._start_ns = 0
        self._lock = Lock()  # the reset service runs in another thread
        uas.subscribe(_TOPIC, MultiDOFJointTrajectory, self._start)
        uas.service("setpoint_trajectory/reset", Trigger, self._reset)
        uas.timer(_EVERY_STEP, self._step)

    def connected(self, connected: bool) -> None:
        """Drop the trajectory after the vehicle was lost or reset."""
        self._points = []

    def _start(self, trajectory: MultiDOFJointTrajectory) -> None:
        points = trajectory.points
        if not points:
            self.uas.warn(_TOPIC, "%s: the trajectory has no points and is not flown", _TOPIC)
            return
        fields = [field for index, point in enumerate(points) for field in _fields(f"points[{index}]", point)]
        if not self.uas.finite(_TOPIC, fields):
            return
        with self._lock:
            self._start_ns = self.uas.ros.now_ns()
            self._points = list(points)
        if self._desired.needed:
            self._publish(points)

    def _publish(self, points: list[MultiDOFJointTrajectoryPoint]) -> None:
        path = self._desired.message
        self.uas.stamp_now(path.header)
        path.poses = [_pose(point.transforms[0]) for point in points if point.transforms]
        self._desired.publish(path)

    def _step(self) -> None:
        if self._points and (point := self._pop_due()) is not None:
            self._send(point)

    def _pop_due(self) -> MultiDOFJointTrajectoryPoint | None:
        """Remove the points that are due and return the last of them."""
        with self._lock:
            points, elapsed_ns = self._points, self.uas.now_ns - self._start_ns
            due = 0
            while due < len(points) and points[due].time_from_start.to_nsec() <= elapsed_ns:
                due += 1
            self._points = points[due:]
        return points[due - 1] if due else None

    def _send(self, point: MultiDOFJointTrajectoryPoint) -> None:
        mask = 0
        position = velocity = acceleration = _ZERO
        yaw = yaw_rate = 0.0
        if point.transforms:
            q = point.transforms[0].rotation
            position = xyz(point.transforms[0].translation)
            yaw = frames.yaw_from_quaternion((q.w, q.x, q.y, q.z))
        else:
            mask |= _NO_TRANSFORM
        if point.velocities:
            velocity, yaw_rate = xyz(point.velocities[0].linear), point.velocities[0].angular.z
        else:
            mask |= _NO_VELOCITY
        if point.accelerations:
            acceleration = xyz(point.accelerations[0].linear)
        else:
            mask |= _NO_ACCELERATION
        frame, time_boot_ms = self._frame.value, self.uas.boot_ms()
        self.uas.link.send(
            position_target(self.uas, time_boot_ms, frame, mask, position, velocity, acceleration, yaw, yaw_rate)
        )

    def _reset(self, _: Any) -> TriggerResponse:
        with self._lock:
            flying, self._points = bool(self._points), []
        return TriggerResponse(success=flying, message="" if flying else "no trajectory is being flown")


def _fields(name: str, point: MultiDOFJointTrajectoryPoint) -> list[tuple[str, float]]:
    """Return (field, value) of the fields sent for a point."""
    fields = []
    for transform in point.transforms[:1]:
        fields += vector_fields(f"{name}.transforms[0].translation", transform.translation)
        fields += vector_fields(f"{name}.transforms[0].rotation", transform.rotation, "xyzw")
    for velocity in point.velocities[:1]:
        fields += vector_fields(f"{name}.velocities[0].linear", velocity.linear)
        fields += vector_fields(f"{name}.velocities[0].angular", velocity.angular, "z")
    for acceleration in point.accelerations[:1]:
        fields += vector_fields(f"{name}.accelerations[0].linear", acceleration.linear)
    return fields


def _pose(transform: Any) -> PoseStamped:
    pose = PoseStamped()
    set_xyz(pose.pose.position, xyz(transform.translation))
    pose.pose.orientation = transform.rotation
    return pose
