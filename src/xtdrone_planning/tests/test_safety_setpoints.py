"""The safety filter's interpretation of setpoints, and the handling of corrected ones."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("mavros_msgs")

from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3
from mavros_msgs.msg import PositionTarget

from xtdrone_control.communication.multirotor import fill
from xtdrone_control.communication.setpoint import acceleration_setpoint, pose_setpoint, velocity_setpoint
from xtdrone_planning.safety.safety_node import SwarmPositions, served_names
from xtdrone_planning.safety.setpoints import (
    Gains,
    Meaning,
    VehicleMotion,
    fill_target,
    meaning_of_acceleration,
    meaning_of_pose,
    meaning_of_target,
    meaning_of_twist,
)

NORTH = math.pi / 2.0
MOTION = VehicleMotion((10.0, 20.0, 5.0), (1.0, 0.0, 0.0), NORTH)
GAINS = Gains(kp=0.5, lag=2.0, max_speed=4.0)


def target(setpoint):
    message = PositionTarget()
    fill(message, setpoint)
    return message


@pytest.mark.parametrize(
    ("setpoint", "velocity", "yaw", "yaw_rate"),
    [
        (velocity_setpoint((1.0, 2.0, 3.0), 0.3, body=False), (1.0, 2.0, 3.0), None, 0.3),
        (velocity_setpoint((1.0, 2.0, 3.0), 0.3, body=True), (-2.0, 1.0, 3.0), None, 0.3),
        (pose_setpoint((12.0, 20.0, 6.0), 1.0, body=False), (1.0, 0.0, 0.5), 1.0, None),
        (pose_setpoint((2.0, 0.0, 0.0), 0.5, body=True), (0.0, 1.0, 0.0), NORTH + 0.5, None),
        (pose_setpoint((10.0, 100.0, 5.0), 0.0, body=False), (0.0, 4.0, 0.0), 0.0, None),
        (acceleration_setpoint((0.0, 1.5, 0.0), 0.2, body=False), (1.0, 3.0, 0.0), None, 0.2),
    ],
)
def test_the_velocity_that_xtdrones_setpoints_mean(setpoint, velocity, yaw, yaw_rate):
    meaning = meaning_of_target(target(setpoint), MOTION, GAINS)
    assert meaning.velocity == pytest.approx(velocity, abs=1e-12)
    assert meaning.yaw == (None if yaw is None else pytest.approx(yaw))
    assert meaning.yaw_rate == yaw_rate


def test_a_feed_forward_is_added_to_the_way_to_the_position():
    message = target(pose_setpoint((12.0, 20.0, 5.0), 0.0, body=False))
    message.type_mask &= ~(8 | 16 | 32)
    message.velocity = Vector3(0.5, 0.0, 0.0)
    assert meaning_of_target(message, MOTION, GAINS).velocity == pytest.approx((1.5, 0.0, 0.0))


@pytest.mark.parametrize("change", ["nothing", "force", "frame", "nan"])
def test_setpoints_without_a_meaning_are_left_alone(change):
    message = target(velocity_setpoint((1.0, 0.0, 0.0), 0.0, body=False))
    if change == "nothing":
        message.type_mask = 511
    elif change == "force":
        message.type_mask = 512 | 7 | 56
    elif change == "frame":
        message.coordinate_frame = 6
    else:
        message.velocity.x = math.nan
    assert meaning_of_target(message, MOTION, GAINS) is None


def test_the_meaning_of_mavross_other_setpoints():
    half = math.sqrt(0.5)
    pose = Pose(Point(11.0, 20.0, 5.0), Quaternion(0.0, 0.0, half, half))
    assert meaning_of_pose(pose, MOTION, GAINS) == Meaning(
        (0.5, 0.0, 0.0), pytest.approx(NORTH), position=(11.0, 20.0, 5.0)
    )
    assert meaning_of_twist(Twist(Vector3(1, 2, 3), Vector3(9, 9, 0.4))) == Meaning((1, 2, 3), None, 0.4)
    assert meaning_of_acceleration(Vector3(0.0, 1.0, 0.0), MOTION, GAINS) == Meaning((1.0, 2.0, 0.0))


def test_a_corrected_setpoint_keeps_the_yaw():
    message = PositionTarget()
    fill_target(message, [1.0, -2.0, 0.5], Meaning((9.0, 9.0, 9.0), yaw=0.7))
    assert message.type_mask == 7 | 7 << 6 | 1 << 11
    assert (message.velocity.x, message.velocity.y, message.velocity.z, message.yaw) == (1.0, -2.0, 0.5, 0.7)
    fill_target(message, [1.0, -2.0, 0.5], Meaning((9.0, 9.0, 9.0), yaw_rate=0.1))
    assert message.type_mask == 7 | 7 << 6 | 1 << 10
    assert message.coordinate_frame == PositionTarget.FRAME_LOCAL_NED


def test_positions_are_flown_on_for_a_while_and_their_age_is_known():
    swarm = SwarmPositions(3)
    swarm.on_all([0, 0, 0, 1, 0, 0, 5, 5, 5, 0, 0, 0, *[math.nan] * 6], 10.0)
    swarm.on_position(1, (math.nan, 0.0, 0.0), 11.0)
    assert swarm.at(10.2, 0.5)[0] == pytest.approx([0.2, 0.0, 0.0])
    assert swarm.at(20.0, 0.5)[0] == pytest.approx([0.5, 0.0, 0.0])
    assert np.isnan(swarm.at(10.0, 0.5)[2]).all()
    assert swarm.old(10.3, 0.5) == [2]
    assert swarm.old(11.0, 0.5) == [0, 1, 2]
    with pytest.raises(ValueError, match="7 numbers are not allowed, 6 for each of 3"):
        swarm.on_all([0.0] * 7, 0.0)


def test_vehicles_on_the_command_line_must_be_in_the_fleet():
    fleet = ["iris_0", "iris_1"]
    assert served_names([], fleet) == fleet
    assert served_names(["iris_1"], fleet) == ["iris_1"]
    with pytest.raises(ValueError, match="vehicle: 'iris_2' is not allowed, iris_0 to iris_1"):
        served_names(["iris_2"], fleet)
