"""A formation flight after /gazebo/reset_simulation is the flight before it, to the last bit."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

import rosgraph
from std_msgs.msg import Float32MultiArray, String
from std_srvs.srv import Empty

FLEET = "iris:3"
PATTERN = "/xtdrone/formation_pattern"


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """The system without a director; formation_pilot.py flies it."""
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path_factory.mktemp("formation"), FLEET)
    try:
        stack.launch("multi_vehicle.launch", f"vehicles:={FLEET}", "rows:=2", "speed:=0", "participants:=6")
        poll(lambda: rosgraph.Master("/system_tests").hasParam("/lockstep/uri"), "roslaunch starts a simulator")
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "all")
        stack.run("leader", "xtdrone_coordination", "leader.py", "iris", "3", "_republish_rate:=30")
        stack.run(
            "followers", "xtdrone_coordination", "follower_consensus.py", "iris", "all", "3", "vel", "_avoid:=topic"
        )
        stack.start("avoid", ["rosrun", "xtdrone_coordination", "avoid_cpp", "iris", "3", "vel"])
        pilot = str(Path(__file__).with_name("formation_pilot.py"))
        stack.start("pilot", [sys.executable, pilot, "__name:=pilot"])
        yield stack
    finally:
        stack.stop()


def flight(stack: Stack, count: int) -> dict[str, Any]:
    """Return the pilot's report of flight number ``count``, from 0."""
    told = stack.graph.hear("/pilot/flight", String)
    poll(lambda: len(told.messages) > count, f"flight {count} is told of; {stack.described()}")
    return json.loads(told.messages[count].data)


def test_the_formation_flies_the_same_after_a_reset(stack: Stack) -> None:
    patterns = stack.graph.hear(PATTERN, Float32MultiArray)
    first = flight(stack, 0)
    assert max(first["errors"]) < 1.0
    assert first["counts"]["/xtdrone/iris_1/cmd_vel_enu"] > 100
    stack.graph.call("/gazebo/reset_simulation", Empty)
    assert flight(stack, 1) == first  # to the last bit
    # nodes outside the lockstep, and late ones, receive an empty pattern
    told = [bool(message.data) for message in patterns.messages]
    empty = told.index(False)
    assert told == [True] * empty + [False] + [True] * (len(told) - empty - 1)
    assert 0 < empty < len(told) - 1
