"""The whole stack over PX4s: ``multi_vehicle.launch autopilot:=hil``, and a stand-in for each vehicle's PX4.

Each vehicle has its own MAVROS node, like real MAVROS.
"""

from __future__ import annotations

import math
import signal
import sys
from collections.abc import Iterator

import pytest
from conftest import REPOSITORY, START_LIMIT, Ear, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

from geometry_msgs.msg import Pose, PoseStamped
from mavros_msgs.msg import State
from rosgraph_msgs.msg import Log

FLEET = "iris:3"
VEHICLES = range(3)
HEIGHT = 3.0  # m
NEAR = 1.0  # m; noise of GPS and barometer is a third of it, two vehicles are 3 m apart
PX4 = REPOSITORY / "src" / "xtdrone_sim" / "tests" / "px4_stand_in.py"


def start_px4(stack: Stack, instance: int) -> None:
    stack.start(f"px4_{instance}", [sys.executable, str(PX4), "iris", str(instance)])


def hears(stack: Stack, *texts: str) -> None:
    """Wait until the simulator has logged all ``texts``."""
    ear = stack.graph.hear("/rosout", Log)
    poll(
        lambda: all(any(text in message.msg for message in list(ear.messages)) for text in texts),
        f"the simulator says {texts}; it said {[message.msg for message in ear.messages]}",
    )


def pose_of(stack: Stack, index: int) -> Ear:
    return stack.graph.hear(f"/iris_{index}/mavros/local_position/pose", PoseStamped)


def in_one_frame(stack: Stack, index: int) -> bool:
    """Return whether the vehicle's own position is its position in the world, unlike the origin of its PX4."""
    pose = pose_of(stack, index).last
    truth = stack.pose(index)
    if pose is None or truth is None:
        return False
    own, place = pose.pose.position, truth.position
    return math.dist((own.x, own.y, own.z), (place.x, place.y, place.z)) < NEAR


def fly(stack: Stack, index: int) -> None:
    """Take off in OFFBOARD by XTDrone's commands, above the spawn position."""
    stack.wait(lambda: in_one_frame(stack, index), f"iris_{index} counts from the world's origin", sim=60.0)
    place = stack.pose(index).position
    target = Pose()
    target.position.x, target.position.y, target.position.z = place.x, place.y, HEIGHT
    stack.graph.say(f"/xtdrone/iris_{index}/cmd_pose_enu", target)
    stack.command(index, "OFFBOARD")
    stack.wait_state(index, mode="OFFBOARD")
    stack.command(index, "ARM")
    stack.wait_state(index, armed=True)
    stack.wait(lambda: stack.settled(index, (place.x, place.y, HEIGHT)), f"iris_{index} is up")


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    import rosgraph

    wait_for_ports()
    graph.hear("/rosout", Log)
    stack = Stack(graph, tmp_path_factory.mktemp("hil"), FLEET)
    try:
        stack.launch(
            "multi_vehicle.launch",
            f"vehicles:={FLEET}",
            "rows:=2",
            "speed:=0",
            "participants:=/iris_0/mavros,/iris_1/mavros,/communication",
            "mavros_nodes:=per_uav",
            "autopilot:=hil",
            "ports:=px4",
        )
        poll(lambda: rosgraph.Master("/system_tests").hasParam("/lockstep/uri"), "roslaunch sets its parameters")
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "all")
        # Now, while time stands still: later it runs as fast as possible and does not wait for this node.
        for index in VEHICLES:
            for ear in (pose_of(stack, index), graph.hear(f"/iris_{index}/mavros/state", State)):
                poll(ear.is_connected, f"{ear.topic} has a publisher", START_LIMIT)
        yield stack
    finally:
        stack.stop()


def test_time_waits_for_the_px4s(stack):
    hears(stack, "holding time at 0: no PX4 has connected for iris_0 (TCP port 4560), iris_1 (TCP port 4561)")
    assert stack.time == 0.0
    for instance in VEHICLES:
        start_px4(stack, instance)
    stack.wait(lambda: stack.time > 1.0, "time starts")
    hears(stack, "iris_0's PX4 answers: in lockstep", "iris_1's PX4 answers: in lockstep")


def test_they_count_from_one_origin_before_they_are_armed(stack):
    for index in VEHICLES:
        stack.wait(lambda index=index: in_one_frame(stack, index), f"iris_{index} counts from the world's origin")
        stack.wait_state(index, armed=False)
    spawned = [stack.pose(index).position for index in VEHICLES]
    assert [(round(place.x), round(place.y)) for place in spawned] == [(0, 3), (3, 3), (0, 6)]
    hears(stack, *(f"iris_{index}: the local frame begins at the shared origin" for index in VEHICLES))


def test_two_fly_by_xtdrones_commands(stack):
    for index in range(2):
        fly(stack, index)
    stack.pass_time(2.0)
    assert all(abs(stack.height(index) - HEIGHT) < 0.5 for index in range(2))


def test_one_px4_is_killed_and_the_other_flies_on(stack):
    stack.programs["px4_0"].kill()
    stack.log_has("roslaunch", "iris_0's PX4", "armed: its motors stop")
    stack.wait(lambda: stack.height(0) < 0.3, "the vehicle without PX4 falls", sim=5.0)
    stack.pass_time(2.0)
    assert abs(stack.height(1) - HEIGHT) < 0.5


def test_a_new_px4_takes_over_the_vehicle(stack):
    start_px4(stack, 0)
    stack.wait(lambda: stack.state(0) is not None and not stack.state(0).armed, "the new PX4 is heard, disarmed")
    hears(stack, "iris_0's PX4 has connected")
    fly(stack, 0)


def test_the_simulator_ends_and_the_px4s_notice(stack):
    stack.programs["roslaunch"].process.send_signal(signal.SIGINT)
    assert stack.programs["roslaunch"].end() == 0
    assert stack.programs["px4_1"].end() == 0
