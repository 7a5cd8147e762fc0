"""Waypoints exchanged between the autopilot's automatic modes and an obstacle-avoidance planner."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isfinite, isnan, nan
from typing import Any

from mavros_msgs.msg import PositionTarget, Trajectory
from nav_msgs.msg import Path
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_common import frames
from xtdrone_mavros.feeds import Feed
from xtdrone_mavros.lib.setpoint_messages import set_xyz, vector_fields, xyz
from xtdrone_mavros.uas import Plugin, Uas

_COUNT = 5  # points of one message
_NO_COMMAND = 65535
_UNUSED = (nan, nan, nan)
_GENERATED, _PATH = "trajectory/generated", "trajectory/path"


class TrajectoryPlugin(Plugin):
    """MAVROS's trajectory: ``desired`` is the autopilot's plan, ``generated`` or ``path`` the planner's detour.

    Positions, velocities and accelerations are ENU, yaw is from east and its rate counter-clockwise; NaN marks an
    unused value. Valid points of ``generated`` are sent in order, without gaps. (MAVROS does not negate yaw rates, and
    converts the yaw of ``path`` twice.)

    PX4 exchanges these messages with COM_OBS_AVOID in its automatic modes. The built-in autopilot has no such function:
    it publishes no ``desired`` and ignores the detour.
    """

    name = "trajectory"

    def __init__(self, uas: Uas) -> None:
        """Subscribe and advertise."""
        super().__init__(uas)
        self._desired = uas.topic("trajectory/desired", Trajectory())
        self._desired.message.header.frame_id = "local_origin"
        self.messages = {"TRAJECTORY_REPRESENTATION_WAYPOINTS": Feed(self._on_waypoints, self._desired)}
        uas.subscribe(_GENERATED, Trajectory, self._on_generated)
        uas.subscribe(_PATH, Path, self._path)

    def _on_waypoints(self, m: Any) -> None:
        if m.valid_points > _COUNT:
            text = "trajectory/desired: %d valid points are not allowed, at most %d; not published"
            self.uas.warn("trajectory/desired", text, m.valid_points, _COUNT)
            return
        message = self._desired.message
        self.uas.stamp_us(message.header, m.time_usec)
        message.point_valid = [index < m.valid_points for index in range(_COUNT)]
        message.command = list(m.command)
        for index, point in enumerate(_points(message)):
            set_xyz(point.position, frames.ned_to_enu(m.pos_x[index], m.pos_y[index], m.pos_z[index]))
            set_xyz(point.velocity, frames.ned_to_enu(m.vel_x[index], m.vel_y[index], m.vel_z[index]))
            set_xyz(point.acceleration_or_force, frames.ned_to_enu(m.acc_x[index], m.acc_y[index], m.acc_z[index]))
            point.yaw = _convert_yaw(m.pos_yaw[index])
            point.yaw_rate = -m.vel_yaw[index]
        self._desired.publish(message)

    def _on_generated(self, message: Trajectory) -> None:
        bezier = message.type == Trajectory.MAV_TRAJECTORY_REPRESENTATION_BEZIER
        used = [index for index in range(_COUNT) if message.point_valid[index]]
        points = [_points(message)[index] for index in used]
        fields = []
        for index, point in zip(used, points, strict=True):
            fields += _point_fields(f"point_{index + 1}", point)
        if bezier:
            fields += [(f"time_horizon[{index}]", message.time_horizon[index]) for index in used]
        if not self.uas.finite(_GENERATED, ((field, value) for field, value in fields if not isnan(value))):
            return
        positions = [frames.enu_to_ned(*xyz(point.position)) for point in points]
        yaws = [_convert_yaw(point.yaw) for point in points]
        time_us = message.header.stamp.to_nsec() // 1000
        if bezier:
            self._send_bezier(time_us, positions, [message.time_horizon[index] for index in used], yaws)
            return
        velocities = [frames.enu_to_ned(*xyz(point.velocity)) for point in points]
        accelerations = [frames.enu_to_ned(*xyz(point.acceleration_or_force)) for point in points]
        self._send_waypoints(time_us, positions, velocities, accelerations, yaws, [-p.yaw_rate for p in points])

    def _path(self, path: Path) -> None:
        poses = [stamped.pose for stamped in path.poses[:_COUNT]]
        fields = []
        for index, pose in enumerate(poses):
            fields += vector_fields(f"poses[{index}].pose.position", pose.position)
            fields += vector_fields(f"poses[{index}].pose.orientation", pose.orientation, "xyzw")
        if not self.uas.finite(_PATH, fields):
            return
        positions = [frames.enu_to_ned(*xyz(pose.position)) for pose in poses]
        orientations = [pose.orientation for pose in poses]
        yaws = [frames.yaw_enu_to_ned(frames.yaw_from_quaternion((q.w, q.x, q.y, q.z))) for q in orientations]
        self._send_waypoints(path.header.stamp.to_nsec() // 1000, positions, [], [], yaws, [])

    def _send_waypoints(
        self,
        time_us: int,
        positions: Sequence[frames.Vector],
        velocities: Sequence[frames.Vector],
        accelerations: Sequence[frames.Vector],
        yaws: Sequence[float],
        yaw_rates: Sequence[float],
    ) -> None:
        """Send the points, NED; missing ones out of five are marked unused."""
        self.uas.link.send(
            mavlink.MAVLink_trajectory_representation_waypoints_message(
                time_us,
                len(positions),
                *_columns(positions),
                *_columns(velocities),
                *_columns(accelerations),
                _pad(yaws),
                _pad(yaw_rates),
                [_NO_COMMAND] * _COUNT,
            )
        )

    def _send_bezier(
        self, time_us: int, positions: Sequence[frames.Vector], spans: Sequence[float], yaws: Sequence[float]
    ) -> None:
        """Send the control points, NED, and the duration of each in seconds."""
        self.uas.link.send(
            mavlink.MAVLink_trajectory_representation_bezier_message(
                time_us, len(positions), *_columns(positions), _pad(spans), _pad(yaws)
            )
        )


def _points(message: Trajectory) -> list[PositionTarget]:
    return [message.point_1, message.point_2, message.point_3, message.point_4, message.point_5]


def _point_fields(name: str, point: PositionTarget) -> list[tuple[str, float]]:
    """Return (field, value) of the fields sent for a point."""
    fields = vector_fields(f"{name}.position", point.position)
    fields += vector_fields(f"{name}.velocity", point.velocity)
    fields += vector_fields(f"{name}.acceleration_or_force", point.acceleration_or_force)
    return [*fields, (f"{name}.yaw", point.yaw), (f"{name}.yaw_rate", point.yaw_rate)]


def _convert_yaw(yaw: float) -> float:
    """Convert a yaw between north clockwise and east counter-clockwise (self-inverse); NaN stays NaN."""
    return frames.yaw_ned_to_enu(yaw) if isfinite(yaw) else yaw


def _columns(vectors: Sequence[frames.Vector]) -> Iterable[list[float]]:
    """Return x, y and z of five vectors as columns, NaN for missing ones."""
    filled = [*vectors, *[_UNUSED] * (_COUNT - len(vectors))]
    return [[vector[axis] for vector in filled] for axis in range(3)]


def _pad(values: Sequence[float]) -> list[float]:
    return [*values, *[nan] * (_COUNT - len(values))]
