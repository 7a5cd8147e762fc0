"""A vehicle joins a running simulation by its launch file, flies, and leaves when that ends."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest
from conftest import REPOSITORY, Graph, Program, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

import rosgraph
from gazebo_msgs.msg import ContactsState, ModelStates
from mavros_msgs.msg import State
from mavros_msgs.srv import CommandBool, SetMode
from nav_msgs.msg import Odometry
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage
from xtdrone_msgs.srv import AddVehicle, GetStatus, RemoveVehicle

FLEET = "iris:1"
STANDBY = 3  # MAV_STATE_STANDBY


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    wait_for_ports("iris:3")
    stack = Stack(graph, tmp_path_factory.mktemp("join"), FLEET)
    try:
        stack.launch("multi_vehicle.launch", f"vehicles:={FLEET}", "reserve:=1", "speed:=5", "lidars:=true", "tf:=true")
        poll(lambda: _is_offered("/simulator/add_vehicle"), "the simulator offers its services")
        yield stack
    finally:
        stack.stop()


def _is_offered(service: str) -> bool:
    try:
        rosgraph.Master("/system_tests").lookupService(service)
    except rosgraph.MasterError:
        return False
    return True


def invite(stack: Stack, name: str, *arguments: str) -> Program:
    file = str(REPOSITORY / "launch" / "vehicle.launch")
    return stack.start(f"launch of {name}", ["roslaunch", file, f"name:={name}", *arguments])


def participants(stack: Stack) -> set[str]:
    return set(stack.graph.call("/simulator/get_status", GetStatus).status.participants)


def test_a_vehicle_joins_flies_and_leaves(stack: Stack) -> None:
    models = stack.graph.hear("/gazebo/model_states", ModelStates)
    state = stack.graph.hear("/iris_1/mavros/state", State)
    truth = stack.graph.hear("/xtdrone/iris_1/ground_truth/odom", Odometry)
    bumper = stack.graph.hear("/iris_1/benchmarker/collision", ContactsState)
    scans = stack.graph.hear("/iris_1/scan", LaserScan)
    frames = stack.graph.hear("/tf_static", TFMessage)
    guest = invite(stack, "iris_1", "model:=iris_2d_lidar", "pose:=[4, 1, 0, 0, 0, 1.5]", "communication:=true")
    stack.wait(lambda: models.last and "iris_1" in models.last.name, "iris_1 is in the world", sim=300.0)
    stack.wait(lambda: state.last and state.last.system_status == STANDBY, "iris_1 is ready", sim=300.0)
    assert {"/mavros", "/lidars", "/robot_tf", "/iris_1/mavros"} <= participants(stack)
    stack.wait(lambda: scans.last, "iris_1's lidar scans, although the fleet of the start has none")
    assert scans.last.header.frame_id == "iris_1/laser_2d"
    assert "iris_1/laser_2d" in {transform.child_frame_id for transform in frames.last.transforms}
    stack.wait(lambda: bumper.last and bumper.last.states, "iris_1 touches the ground")
    assert bumper.last.states[0].collision2_name == "ground_plane::link::collision"
    assert stack.graph.call("/iris_1/mavros/set_mode", SetMode, custom_mode="AUTO.TAKEOFF").mode_sent
    arming = "/iris_1/mavros/cmd/arming"  # rejected until the position estimate is valid
    stack.wait(lambda: stack.graph.call(arming, CommandBool, value=True).success, "iris_1 arms")
    stack.wait(lambda: truth.last and truth.last.pose.pose.position.z > 1.0, "iris_1 flies")
    stack.wait(lambda: not bumper.last.states, "iris_1 touches nothing")
    place = truth.last.pose.pose.position
    assert (place.x, place.y) == pytest.approx((4.0, 1.0), abs=0.5)
    assert "did not arrive" not in guest.output
    guest.process.send_signal(signal.SIGINT)
    assert guest.end() == 0
    stack.wait(lambda: models.last.name == ["ground_plane", "iris_0"], "iris_1 has left")
    assert participants(stack) == {"/mavros", "/lidars", "/robot_tf"}
    stack.wait(lambda: not _is_offered("/iris_1/scan/failure"), "its lidar's service has ended")
    assert rosgraph.Master("/system_tests").getParam("/xtdrone/fleet") == FLEET


def test_places_are_used_again_and_refusals_name_the_reason(stack: Stack) -> None:
    answers = [
        stack.graph.call("/simulator/add_vehicle", AddVehicle, name="typhoon_h480_0", pose=[-4.0, 0.0]),
        stack.graph.call("/simulator/add_vehicle", AddVehicle, name="iris_5"),
        stack.graph.call("/simulator/add_vehicle", AddVehicle, name="iris_5", pose=[float("nan"), 0.0]),
        stack.graph.call("/simulator/remove_vehicle", RemoveVehicle, name="iris_5"),
        stack.graph.call("/simulator/remove_vehicle", RemoveVehicle, name="typhoon_h480_0"),
        stack.graph.call("/simulator/remove_vehicle", RemoveVehicle, name="iris_0"),
    ]
    assert [(answer.success, answer.message) for answer in answers] == [
        (True, "typhoon_h480_0 has joined, 2 vehicles are in the simulation"),
        (False, "no place is free: 2 vehicles are in the simulation; reserve:=N keeps N more places"),
        (False, "pose: x: nan is not allowed, -100000 to 100000 m"),
        (False, "name: 'iris_5' is not in the simulation; there are iris_0, typhoon_h480_0"),
        (True, "typhoon_h480_0 has left, 1 vehicle is in the simulation"),
        (False, "iris_0 is the only vehicle in the simulation and cannot leave"),
    ]


def test_a_launch_whose_vehicle_is_refused_ends_with_the_reason(stack: Stack) -> None:
    guest = invite(stack, "iris_0")
    guest.end()
    assert "name: 'iris_0' is already in the simulation" in guest.output
