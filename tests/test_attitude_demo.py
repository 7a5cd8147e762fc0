"""A rospy program written to XTDrone's interface flies iris_0: unset frames, attitudes, rates, repeated offsets."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

import rosgraph
from mavros_msgs.msg import PositionTarget
from mavros_msgs.srv import ParamGet
from std_msgs.msg import String

FLEET = "iris:1"
PLACE = 0.3  # m, greatest distance from a goal


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path_factory.mktemp("attitude_demo"), FLEET)
    try:
        stack.launch("multi_vehicle.launch", f"vehicles:={FLEET}", "speed:=1")
        poll(lambda: rosgraph.Master("/system_tests").hasParam("/lockstep/uri"), "roslaunch starts a simulator")
        yield stack
    finally:
        stack.stop()


def test_the_demo_flies_and_a_repeated_offset_is_one_command(stack: Stack) -> None:
    stack.start("demo", [sys.executable, str(Path(__file__).with_name("attitude_demo.py"))])
    told = stack.graph.hear("/demo/flight", String)
    poll(lambda: told.last, f"the flight is reported; {stack.described()}")
    legs = json.loads(told.last.data)
    assert legs["services"] == [True, True]
    assert legs["position"] == pytest.approx([0.0, 0.0, 2.0], abs=PLACE)
    assert legs["attitude"] == pytest.approx([1.0, 0.0, 2.0], abs=PLACE)
    assert legs["rates"] == pytest.approx([0.0, 0.0, 2.0], abs=PLACE)
    x, y, z = legs["hold"]
    assert legs["offset"] == pytest.approx([x + 2.0, y, z], abs=PLACE), "2 m on, not further with every repetition"
    log = stack.programs["roslaunch"].output
    assert log.count("setpoint_raw/local: coordinate_frame is 0, unset; it counts as 1 (LOCAL_NED)") == 1


def test_a_frame_that_px4_rejects_is_rejected_where_it_enters(stack: Stack) -> None:
    target = PositionTarget(coordinate_frame=PositionTarget.FRAME_LOCAL_OFFSET_NED, type_mask=0b100111111000)
    stack.graph.say("/iris_0/mavros/setpoint_raw/local", target)
    log = stack.programs["roslaunch"]
    poll(lambda: "coordinate_frame 7 is not allowed, (1, 8, 9) are" in log.output, "the frame is rejected")


def test_param_get_names_the_parameter_of_today(stack: Stack) -> None:
    answer = stack.graph.call("/iris_0/mavros/param/get", ParamGet, param_id="EKF2_HGT_MODE")
    assert not answer.success
    log = stack.programs["roslaunch"]
    poll(lambda: "EKF2_HGT_MODE does not exist: PX4 v1.14 has EKF2_HGT_REF in its place" in log.output, "the log")
