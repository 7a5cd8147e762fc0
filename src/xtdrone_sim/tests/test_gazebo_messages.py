"""Gazebo's message of the true states."""

import numpy as np
import pytest

pytest.importorskip("rospy", reason="needs rospy")

from geometry_msgs.msg import Point, Pose, Quaternion, Twist, Vector3

from xtdrone_sim.physics.vehicle_dynamics import PLANT
from xtdrone_sim.topics.model_states import ModelStatesMessage
from xtdrone_worlds.shapes import visual
from xtdrone_worlds.worlds.sdf import SdfModel

TREE = SdfModel("tree", pose=visual.Pose((4.0, 5.0, 6.0)))
LEVEL = Quaternion(0.0, 0.0, 0.0, 1.0)


def plant():
    vehicles = np.zeros(2, PLANT)
    vehicles["position"] = [[1.0, 2.0, 3.0], [-1.0, -2.0, -3.0]]
    vehicles["velocity"] = [[0.1, 0.2, 0.3], [0.0, 0.0, 0.0]]
    half = np.sqrt(0.5)
    vehicles["q"] = [[half, 0.0, 0.0, half], [1.0, 0.0, 0.0, 0.0]]  # the first looks along y
    vehicles["rates"] = [[1.0, 0.0, 0.0], [0.0, 0.0, 2.0]]
    return vehicles


def test_states_are_those_of_ground_vehicles_and_models():
    states = ModelStatesMessage(["iris_0", "iris_1"], [TREE]).fill(plant())
    half = np.sqrt(0.5)
    assert states.name == ["ground_plane", "iris_0", "iris_1", "tree"]
    assert states.pose == [
        Pose(Point(0.0, 0.0, 0.0), LEVEL),
        Pose(Point(1.0, 2.0, 3.0), Quaternion(0.0, 0.0, half, half)),
        Pose(Point(-1.0, -2.0, -3.0), LEVEL),
        Pose(Point(4.0, 5.0, 6.0), LEVEL),
    ]
    assert states.twist[1].linear == Vector3(0.1, 0.2, 0.3)
    spin = states.twist[1].angular
    assert (spin.x, spin.y, spin.z) == pytest.approx((0.0, 1.0, 0.0))
    assert [states.twist[i] for i in (0, 2, 3)] == [Twist(), Twist(angular=Vector3(0.0, 0.0, 2.0)), Twist()]


def test_models_added_to_the_message_are_gone_from_the_next():
    message = ModelStatesMessage(["iris_0", "iris_1"], [TREE])
    states = message.fill(plant())
    states.name.append("actor")
    states.pose.append(Pose())
    states.twist.append(Twist())
    states = message.fill(plant())
    assert len(states.name) == len(states.pose) == len(states.twist) == 4
