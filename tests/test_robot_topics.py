"""Robots in the running simulator: the topics of XTDrone's UGV, lockstep, restart, and rejections."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rospy
from conftest import START_LIMIT, Graph, Program, Stack, poll, wait_for_ports
from gazebo_msgs import srv
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Twist, Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_srvs.srv import Empty
from tf2_msgs.msg import TFMessage
from xtdrone_msgs.msg import SceneModels

FLEET = "iris:1"
Start = Callable[..., Program]


@pytest.fixture
def stack(graph: Graph, tmp_path: Path) -> Iterator[Stack]:
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path, FLEET)
    yield stack
    stack.stop()


@pytest.fixture
def start(stack: Stack) -> Start:
    def run(robots: str, *arguments: str) -> Program:
        settings = (f"_fleet:={FLEET}", "_speed:=5", f"_robots:={robots}", *arguments)
        return stack.run("simulator", "xtdrone_sim", "simulator.py", *settings)

    return run


def test_a_ugv_and_a_car_drive_by_cmd_vel(stack: Stack, start: Start, tmp_path: Path) -> None:
    for kind in ("ugv", "car"):  # these kinds drive on after a single command
        (tmp_path / f"{kind}.yaml").write_text(f"extends: {kind}\nlimits: {{timeout: 0}}\n")
    start(
        f"[{{name: ugv_0, type: {tmp_path}/ugv.yaml, pose: [5, 0, 1.5]}}, {{name: car_0, type: {tmp_path}/car.yaml}}]"
    )
    graph = stack.graph
    states, odometry = graph.hear("/gazebo/model_states", ModelStates), graph.hear("/ugv_0/odom", Odometry)
    joints, tf = graph.hear("/car_0/joint_states", JointState), graph.hear("/tf", TFMessage)
    fixed, models = graph.hear("/tf_static", TFMessage), graph.hear("/xtdrone/models", SceneModels)
    poll(lambda: odometry.messages, "odometry", START_LIMIT)
    assert states.last.name == ["ground_plane", "iris_0", "ugv_0", "car_0"]
    assert "ugv_0" in models.last.sdf
    assert odometry.last.pose.pose.position.x == 0.0

    graph.say("/ugv_0/cmd_vel", Twist(linear=Vector3(x=1.0), angular=Vector3(z=0.2)))
    graph.say("/car_0/cmd_vel", Twist(linear=Vector3(x=2.0), angular=Vector3(z=0.3)))
    stack.wait(lambda: odometry.last.pose.pose.orientation.z > math.sin(0.5), "the UGV has turned by 1 rad")
    turned = odometry.last
    assert (turned.header.frame_id, turned.child_frame_id) == ("ugv_0/odom", "ugv_0/base_link")
    assert (turned.twist.twist.linear.x, turned.twist.twist.angular.z) == pytest.approx((1.0, 0.2))
    place, yaw = turned.pose.pose.position, 2.0 * math.asin(turned.pose.pose.orientation.z)
    # on a circle of 5 m to the left of the start, except for the distance of the acceleration
    assert math.hypot(place.x, place.y - 5.0) == pytest.approx(5.0, abs=0.4)
    assert math.atan2(place.y, place.x) == pytest.approx(0.5 * yaw, abs=0.1)

    stack.wait(lambda: joints.last.velocity[0] > 5.0, "the car's wheels turn")
    angles = dict(zip(joints.last.name, joints.last.position, strict=True))
    assert angles["front_left_steering_joint"] > 0.3 > angles["front_right_steering_joint"] > 0.2
    names = {(frame.header.frame_id, frame.child_frame_id) for frame in tf.last.transforms}
    assert names >= {("ugv_0/odom", "ugv_0/base_link"), ("car_0/odom", "car_0/base_link")}
    assert {("ugv_0/base_link", "ugv_0/left_wheel"), ("car_0/front_left_steering", "car_0/front_left_wheel")} <= names
    assert "front_left_steering_joint" in rospy.get_param("/car_0/robot_description")
    assert {frame.child_frame_id for frame in fixed.last.transforms} >= {"ugv_0/odom", "ugv_0/platform", "car_0/odom"}

    graph.say("/ugv_0/cmd_vel", Twist(linear=Vector3(x=math.nan)))
    stack.log_has("simulator", "/ugv_0/cmd_vel: linear.x: nan is not allowed, a finite number")
    graph.call("/gazebo/reset_world", Empty)
    stack.wait(lambda: abs(odometry.last.pose.pose.position.x) < 1e-6, "the UGV is back where it started")
    state = graph.call("/gazebo/get_model_state", srv.GetModelState, model_name="ugv_0")
    assert (state.pose.position.x, state.pose.position.y) == (5.0, 0.0)

    assert graph.call("/gazebo/delete_model", srv.DeleteModel, model_name="ugv_0").success
    graph.say("/ugv_0/cmd_vel", Twist(linear=Vector3(x=1.0)))
    stack.log_has("simulator", "/ugv_0/cmd_vel: ugv_0 has been deleted")
    stack.wait(lambda: "ugv_0" not in states.last.name, "the UGV is gone")


def test_a_boat_sails_on_waves_by_cmd_vel(stack: Stack, start: Start, tmp_path: Path) -> None:
    (tmp_path / "boat.yaml").write_text("extends: boat\nlimits: {timeout: 0}\n")
    start(f"[{{name: boat_0, type: {tmp_path}/boat.yaml, pose: [10, 0, 1.57]}}]")
    graph = stack.graph
    odometry, fixed = graph.hear("/boat_0/odom", Odometry), graph.hear("/tf_static", TFMessage)
    joints = graph.hear("/boat_0/joint_states", JointState)
    poll(lambda: odometry.messages, "odometry", START_LIMIT)
    graph.say("/boat_0/cmd_vel", Twist(linear=Vector3(x=1.0)))
    stack.wait(lambda: odometry.last.pose.pose.position.x > 3.0, "the boat has gone ahead")
    assert (odometry.last.header.frame_id, odometry.last.child_frame_id) == ("boat_0/odom", "boat_0/base_link")
    assert odometry.last.pose.pose.position.z != 0.0  # on waves
    assert joints.last.name == []
    assert {frame.child_frame_id for frame in fixed.last.transforms} >= {"boat_0/odom", "boat_0/platform"}
    assert "platform" in rospy.get_param("/boat_0/robot_description")
    graph.call("/gazebo/reset_world", Empty)
    stack.wait(lambda: abs(odometry.last.pose.pose.position.x) < 0.5, "the boat is back where it started")


@pytest.mark.parametrize(
    ("robots", "words"),
    [
        ("tank:1", "robots: type 'tank' is not known; there are boat, car, ugv"),
        ("[{name: iris_0, type: ugv}]", "robots: 'iris_0' is the name of a vehicle or of a model in the world"),
        ("[{name: ugv_0, type: ugv, pose: [0, 3]}]", "ugv_0: the start at 0 3 m is not free: it is 0."),
    ],
)
def test_robots_that_cannot_be_there_end_the_start(robots: str, words: str, start: Start) -> None:
    simulator = start(robots)
    assert simulator.end(100.0) == 1
    assert words in simulator.output
