"""States of rigid parts as Gazebo's services return and accept them: relative to moving frames, and as ROS messages."""

from __future__ import annotations

from typing import Any, NamedTuple

import genpy
import numpy as np
from geometry_msgs.msg import Point, Quaternion, Twist, Vector3
from geometry_msgs.msg import Pose as PoseMessage

from xtdrone_common.poses import Pose, compose, conjugate, inverse, rotate
from xtdrone_common.rotation import Vector
from xtdrone_sim.gazebo.request_limits import FARTHEST, FASTEST, STRONGEST, check_quaternion, check_vector


class State(NamedTuple):
    """Motion of a rigid part.

    Attributes:
        pose: pose in a frame, ENU for the world.
        velocity: velocity of its origin, m/s.
        spin: rad/s.
    """

    pose: Pose = Pose()
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)


STANDING = State()
"""At rest at the origin of the world."""


def relative_to(state: State, frame: State) -> State:
    """Return a state, given in the world, relative to a frame and in its axes."""
    back = conjugate(frame.pose.orientation)
    return State(
        compose(inverse(frame.pose), state.pose),
        rotate(back, _minus(state.velocity, frame.velocity)),
        rotate(back, _minus(state.spin, frame.spin)),
    )


def in_world(state: State, frame: State) -> State:
    """Return a state, given in the axes of a frame, in the world; the velocity of the frame is not added."""
    turn = frame.pose.orientation
    return State(compose(frame.pose, state.pose), rotate(turn, state.velocity), rotate(turn, state.spin))


def part_of(state: State, pose: Pose) -> State:
    """Return the state of a part fixed at ``pose`` in a body."""
    arm = rotate(state.pose.orientation, pose.position)
    sweep = np.cross(state.spin, arm).tolist()
    vx, vy, vz = state.velocity
    return State(compose(state.pose, pose), (vx + sweep[0], vy + sweep[1], vz + sweep[2]), state.spin)


def _minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


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
