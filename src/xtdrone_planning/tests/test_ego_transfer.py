"""The camera's pose and the setpoints between EGO-Planner and a vehicle."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("quadrotor_msgs.msg")

import rospy
from geometry_msgs.msg import Point, PoseStamped, Quaternion, Vector3
from mavros_msgs.msg import PositionTarget
from quadrotor_msgs.msg import PositionCommand

from xtdrone_common.rotation import from_euler, rotate
from xtdrone_planning.replanning.ego_transfer_node import optical_pose, setpoint_of

STAMP = rospy.Time(12, 500_000_000)


def pose(yaw: float = 0.0, x: float = 1.0) -> PoseStamped:
    message = PoseStamped()
    message.header.stamp = STAMP
    message.pose.position = Point(x, 2.0, 3.0)
    w, i, j, k = from_euler(0.0, 0.0, yaw)
    message.pose.orientation = Quaternion(i, j, k, w)
    return message


def command(**fields: object) -> PositionCommand:
    ready = PositionCommand.TRAJECTORY_STATUS_READY
    given = {"position": Point(1, 2, 3), "velocity": Vector3(4, 5, 6), "acceleration": Vector3(7, 8, 9), "yaw": 0.5,
             "yaw_dot": -0.25, "trajectory_flag": ready}  # fmt: skip
    return PositionCommand(**{**given, **fields})


def test_a_level_vehicle_has_the_orientation_of_the_program_upstream():
    found = optical_pose(pose())
    assert found is not None
    q = found.pose.orientation
    assert (q.x, q.y, q.z, q.w) == pytest.approx((-0.5, 0.5, -0.5, 0.5))
    assert found.header.frame_id == "world"
    assert found.header.stamp == STAMP
    assert (found.pose.position.x, found.pose.position.y, found.pose.position.z) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("yaw", [-2.0, 0.7, 3.0])
def test_the_optical_axis_looks_where_the_vehicle_looks(yaw: float):
    found = optical_pose(pose(yaw))
    assert found is not None
    q = found.pose.orientation
    turn = (q.w, q.x, q.y, q.z)
    assert rotate(turn, 0.0, 0.0, 1.0) == pytest.approx((math.cos(yaw), math.sin(yaw), 0.0))
    assert rotate(turn, 0.0, 1.0, 0.0) == pytest.approx((0.0, 0.0, -1.0))


def test_a_pose_that_is_not_finite_is_dropped():
    assert optical_pose(pose(x=math.nan)) is None


def test_a_command_becomes_a_setpoint_with_feed_forward():
    found = setpoint_of(command(), STAMP)
    assert found is not None
    assert found.coordinate_frame == PositionTarget.FRAME_LOCAL_NED
    assert found.type_mask == 0
    parts = found.position, found.velocity, found.acceleration_or_force
    assert np.array([(part.x, part.y, part.z) for part in parts]).ravel().tolist() == list(range(1, 10))
    assert (found.yaw, found.yaw_rate) == (0.5, -0.25)


@pytest.mark.parametrize(
    "fields",
    [
        {"trajectory_flag": PositionCommand.TRAJECTORY_STATUS_EMPTY},
        {"trajectory_flag": PositionCommand.TRAJECTORY_STATUS_COMPLETED},
        {"yaw": math.inf},
        {"velocity": Vector3(0, math.nan, 0)},
    ],
)
def test_a_command_that_must_not_be_flown_is_dropped(fields: dict[str, object]):
    assert setpoint_of(command(**fields), STAMP) is None
