"""Flight by vision alone through ROS, as users of VINS-Fusion fly: no GPS, poses by vins_transfer.py."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import START_LIMIT, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from mavros_msgs.srv import ParamGet

FLEET = "iris:1"
PLACE_LIMIT = 0.15  # m
SINK_LIMIT = 2.0  # m/s; with motors stopped half a metre up it would reach 3
# QGroundControl's file: no GPS; vision provides height, position and heading
PARAMETERS = "1\t1\tEKF2_GPS_CTRL\t0\t6\n1\t1\tEKF2_HGT_REF\t3\t6\n1\t1\tEKF2_EV_CTRL\t11\t6\n"


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    wait_for_ports(FLEET)
    folder = tmp_path_factory.mktemp("vision")
    (folder / "iris_0.params").write_text(PARAMETERS, "utf-8")
    stack = Stack(graph, folder, FLEET)
    try:
        stack.launch(
            "multi_vehicle.launch", f"vehicles:={FLEET}", "rows:=1", "speed:=0", "participants:=4", f"params:={folder}"
        )
        poll(_simulator_is_up, "roslaunch sets its parameters")
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "0")
        stack.run("transfer", "xtdrone_perception", "vins_transfer.py", "iris", "0")
        source = Path(__file__).with_name("vision_source.py")
        stack.start("vision", [sys.executable, str(source), "iris_0"])
        stack.wait(lambda: stack.pose(0) and stack.time > 0.0, "the simulation runs", wall=START_LIMIT)
        stack.wait_state(0)
        yield stack
    finally:
        stack.stop()


def _simulator_is_up() -> bool:
    import rosgraph

    return bool(rosgraph.Master("/system_tests").hasParam("/lockstep/uri"))


def test_it_takes_off_and_holds_position_by_vision(stack: Stack) -> None:
    place = stack.fly(0, 3.0)
    assert stack.graph.call("/iris_0/mavros/param/get", ParamGet, param_id="EKF2_GPS_CTRL").value.integer == 0
    local = stack.graph.hear("/iris_0/mavros/local_position/pose", PoseStamped)
    stack.pass_time(10.0)
    p, true = local.last.pose.position, stack.pose(0).position
    assert math.dist((p.x, p.y, p.z), (true.x, true.y, true.z)) < PLACE_LIMIT
    assert stack.settled(0, place, 0.3)
    assert stack.state(0).mode == "OFFBOARD"


def test_without_vision_it_descends(stack: Stack) -> None:
    """The estimate ends some seconds after the last pose; the vehicle descends by itself."""
    reports = stack.graph.hear("/diagnostics", DiagnosticArray)
    stack.programs["vision"].kill()
    stack.wait(lambda: stack.state(0).mode != "OFFBOARD", "it notices", sim=20.0)
    texts = {s.message for m in reports.messages for s in m.status if s.name == "iris_0: pose transfer"}
    assert "no new poses for 1 s" in texts
    stack.wait_landed(0, sim=40.0)
    assert stack.safety.sink["iris_0"] < SINK_LIMIT
    assert stack.safety.tilt["iris_0"] < math.radians(30.0)
