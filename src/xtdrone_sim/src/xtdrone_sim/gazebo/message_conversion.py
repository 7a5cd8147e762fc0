"""Conversion between Gazebo's ROS messages and states, with checks of all received values."""

from __future__ import annotations

from typing import Any

import genpy
from geometry_msgs.msg import Point, Quaternion, Twist, Vector3
from geometry_msgs.msg import Pose as PoseMessage

from xtdrone_control.rotation import Vector
from xtdrone_sim.gazebo.frames import State
from xtdrone_sim.gazebo.request_limits import FARTHEST, FASTEST, STRONGEST, check_quaternion, check_vector
from xtdrone_sim.shapes.visual import Pose


def _vector(message: Any) -> Vector:
    return (message.x, message.y, message.z)


def read_pose(message: PoseMessage) -> Pose:
    """Return a pose.

    Raises:
        RequestError: a number is not allowed.
    """
    q = message.orientation
    position = check_vector("position", _vector(message.position), FARTHEST)
    return Pose(position, check_quaternion("orientation", (q.w, q.x, q.y, q.z)))


def read_state(pose: PoseMessage, twist: Twist) -> State:
    """Return pose and velocities.

    Raises:
        RequestError: a number is not allowed.
    """
    velocity = check_vector("twist: linear", _vector(twist.linear), FASTEST)
    return State(read_pose(pose), velocity, check_vector("twist: angular", _vector(twist.angular), FASTEST))


def read_wrench(request: Any) -> State:
    """Return point, force and torque of an ApplyBodyWrench request; see ``Models.pushing``.

    Raises:
        RequestError: a number is not allowed.
    """
    point = check_vector("reference_point", _vector(request.reference_point), FARTHEST)
    force = check_vector("wrench: force", _vector(request.wrench.force), STRONGEST)
    return State(Pose(point), force, check_vector("wrench: torque", _vector(request.wrench.torque), STRONGEST))


def pose_message(pose: Pose) -> PoseMessage:
    """Return a pose as a message."""
    w, x, y, z = pose.orientation
    return PoseMessage(Point(*pose.position), Quaternion(x, y, z, w))


def twist_message(state: State) -> Twist:
    """Return the velocities of a state as a message."""
    return Twist(Vector3(*state.velocity), Vector3(*state.spin))


def microseconds(value: genpy.Time | genpy.Duration) -> int:
    """Return a ROS time or duration in microseconds."""
    return int(value.to_nsec()) // 1000
