"""Another MAVROS in our layer's place, nodes of one real vehicle, and the launch files for them.

The MAVROS layer, outside the lockstep, replaces it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

import pytest
from conftest import REPOSITORY, START_LIMIT, Graph, Stack, wait_for_ports

pytest.importorskip("rospy")

from mavros_msgs.msg import ParamValue
from mavros_msgs.srv import ParamSet
from roslaunch.config import ROSLaunchConfig
from roslaunch.core import RLException
from roslaunch.xmlloader import XmlLoader
from xtdrone_msgs.srv import GetStatus

HEIGHT = 1.5  # m
MAVROS = REPOSITORY / "src/xtdrone_mavros/nodes/mavros_node.py"


def load(file: str, *arguments: str) -> ROSLaunchConfig:
    """Return roslaunch's configuration of a launch file and its arguments."""
    config = ROSLaunchConfig()
    XmlLoader().load(str(REPOSITORY / "launch" / file), config, argv=list(arguments), verbose=False)
    return config


def parameters(config: ROSLaunchConfig) -> dict[str, Any]:
    return {name: param.value for name, param in config.params.items()}


@pytest.mark.parametrize(("mavros", "joins"), [("true", 1), ("elsewhere", 1), ("false", 0)])
def test_time_waits_for_our_mavros_alone(mavros: str, joins: int) -> None:
    alone = load("multi_vehicle.launch", f"mavros:={mavros}", "tf:=true")
    assert alone.params["/simulator/participants"].value == joins + 1
    assert [node.name for node in alone.nodes if node.name == "mavros"] == ["mavros"] * (mavros == "true")
    formation = parameters(load("formation.launch", "n:=3", f"mavros:={mavros}"))
    assert formation["/simulator/participants"] == joins + 2 + 2 + 3  # leader, director; followers; communication
    assert formation["/xtdrone/swarm_topic"] == ("/xtdrone/swarm" if joins else "")


def test_the_nodes_of_a_real_vehicle() -> None:
    both = load("real_uav.launch", "number:=2", "nodes:=communication,follower", "n:=4")
    assert {node.name: node.args for node in both.nodes} == {
        "iris_2_communication": "iris 2",
        "follower_2": "iris 2 4 vel",
    }
    assert parameters(both) == {
        "/iris_2_communication/cmd_timeout": 1.0,
        "/iris_2_communication/lockstep": False,
        "/follower_2/class": "",
        "/follower_2/vel_max": 1.0,
        "/follower_2/lockstep": False,
    }


def test_a_real_vehicle_with_our_mavros_under_another_name() -> None:
    own = ("type:=x500", "vehicles:=x500:2", "fcu_url:=udp://:14540@", "mavros:=/mavros")
    config = load("real_uav.launch", "number:=1", *own)
    assert parameters(config) == {
        "/xtdrone/fleet": "x500:2",
        "/mavros/fcu_url": "udp://:14540@",
        "/mavros/tgt_system": 2,
        "/mavros/lockstep": False,
        "/x500_1_communication/cmd_timeout": 1.0,
        "/x500_1_communication/lockstep": False,
    }
    mavros, communication = config.nodes
    assert (mavros.namespace, mavros.name) == ("/", "mavros")
    names = "state local_position/pose local_position/velocity_local setpoint_raw/local set_mode cmd/arming"
    remaps = [[f"/x500_1/mavros/{name}", f"/mavros/{name}"] for name in names.split()]
    assert communication.remap_args == remaps


@pytest.mark.parametrize(
    "arguments",
    [
        ["number:=1", "nodes:=folower"],
        ["number:=0", "nodes:=follower"],
        ["number:=3", "nodes:=follower", "n:=3"],
        [],
    ],
)
def test_wrong_arguments_end_the_launch(arguments: list[str]) -> None:
    with pytest.raises(RLException):
        load("real_uav.launch", *arguments)


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    wait_for_ports()
    stack = Stack(graph, tmp_path_factory.mktemp("real_mavros"))
    try:
        stack.launch("multi_vehicle.launch", "vehicles:=iris:2", "rows:=2", "speed:=3", "mavros:=false")
        stack.wait(lambda: stack.time > 0.0, "time runs without a MAVROS", wall=START_LIMIT)
        yield stack
    finally:
        stack.stop()


def test_vehicles_fly_with_a_mavros_outside_the_lockstep(stack: Stack) -> None:
    """iris_0 flies with a communication node in lockstep, iris_1 with nodes outside the lockstep."""
    graph = stack.graph
    own = ["__name:=mavros", "__ns:=/iris_0", "_lockstep:=false", "_fcu_url:=udp://:24540@127.0.0.1:34580"]
    stack.start("mavros", [sys.executable, str(MAVROS), *own])
    stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "0")
    launch = str(REPOSITORY / "launch/real_uav.launch")
    stack.start("real_uav", ["roslaunch", launch, "number:=1", "fcu_url:=udp://:24541@127.0.0.1:34581"])
    for i in range(2):  # setpoints are sent by wall time: a busy machine must not end OFFBOARD
        stack.wait_state(i, sim=300.0)
        answer = graph.call(
            f"/iris_{i}/mavros/param/set", ParamSet, param_id="COM_OF_LOSS_T", value=ParamValue(real=60.0)
        )
        assert answer.success
    for i in range(2):
        stack.fly(i, HEIGHT)
    status = graph.call("/simulator/get_status", GetStatus).status
    assert status.participants == ["/communication"]
