"""The same nodes without a simulator, as on a real vehicle: no sim time, plain topics, rospy's rate.

This test acts as MAVROS: it publishes MAVROS's topics and receives the commands.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest
from conftest import WALL_LIMIT, Graph, Stack, poll

pytest.importorskip("rospy")

from geometry_msgs.msg import PoseStamped, Twist
from mavros_msgs.msg import PositionTarget
from std_msgs.msg import Float32MultiArray, Int32MultiArray

EPOCH = 1.6e9  # s; wall time is later, simulated time far from it


@pytest.fixture
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    graph.forget()
    stack = Stack(graph, tmp_path_factory.mktemp("vehicle"))
    yield stack
    stack.stop()
    graph.forget()


def pose(x: float, y: float, z: float) -> PoseStamped:
    message = PoseStamped()
    message.pose.position.x, message.pose.position.y, message.pose.position.z = x, y, z
    message.pose.orientation.w = 1.0
    return message


def test_follower_and_communication_run_on_wall_time(stack: Stack) -> None:
    graph = stack.graph
    stack.run("iris_1_communication", "xtdrone_control", "multirotor_communication.py", "iris", "1")
    stack.run("follower_1", "xtdrone_coordination", "follower_consensus.py", "iris", "1", "2", "vel")
    commands = graph.hear("/xtdrone/iris_1/cmd_vel_enu", Twist)
    targets = graph.hear("/iris_1/mavros/setpoint_raw/local", PositionTarget)
    graph.say("/xtdrone/communication_topology", Int32MultiArray(data=[0, 0, 1, 0]))
    graph.say("/xtdrone/formation_pattern", Float32MultiArray(data=[3.0, 0.0, 0.0]))

    def fly() -> bool:
        """Publish MAVROS's present messages; the follower is a metre west of its slot."""
        graph.say("/iris_0/mavros/local_position/pose", pose(0.0, 0.0, 5.0))
        graph.say("/iris_1/mavros/local_position/pose", pose(2.0, 0.0, 5.0))
        return bool(targets.last) and targets.last.velocity.x > 0.9 and len(commands.messages) >= 20

    poll(fly, "the follower commands, and its communication node tells MAVROS")
    assert commands.last.linear.x == pytest.approx(1.0)
    assert (commands.last.linear.y, commands.last.linear.z) == (0.0, 0.0)
    assert targets.last.header.stamp.to_sec() > EPOCH
    assert targets.last.coordinate_frame == PositionTarget.FRAME_LOCAL_NED
    # Their own clock sets the pace: there is no /clock.
    first = len(commands.messages)
    began = time.monotonic()
    poll(lambda: fly() and len(commands.messages) >= first + 30, "a second's commands", WALL_LIMIT)
    assert time.monotonic() - began > 0.7, "30 commands at 30 Hz take a second"
