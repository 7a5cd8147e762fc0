"""Launch files of XTDrone's form: the nodes they name exist here; they start a flight or end with a clear line."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import REPOSITORY, START_LIMIT, Graph, Stack, wait_for_ports

pytest.importorskip("rospy")

from mavros_msgs.msg import ParamValue
from mavros_msgs.srv import ParamSet
from roslaunch.config import load_config_default
from tf2_msgs.msg import TFMessage

GENERATED = REPOSITORY / "tests/generated.launch"
STAND_INS = REPOSITORY / "src/xtdrone_sim/stand_ins"
NAMES = ("iris_0", "iris_1", "typhoon_h480_0")
FLEET = "iris:2,typhoon_h480:1"


@pytest.fixture
def stack(graph: Graph, tmp_path: Path) -> Iterator[Stack]:
    """An empty system; programs that the test starts in it are stopped afterwards."""
    wait_for_ports(FLEET)
    graph.forget()
    stack = Stack(graph, tmp_path, FLEET)
    yield stack
    stack.stop()


def test_a_generated_launch_file_flies(stack: Stack) -> None:
    graph = stack.graph
    stack.start("roslaunch", ["roslaunch", str(GENERATED)])
    stack.wait(lambda: stack.time > 0.0, "time runs", wall=START_LIMIT)
    poses = [stack.wait(lambda i=i: stack.pose(i), f"vehicle {i} has a pose") for i in range(3)]
    places = [(round(pose.position.x, 1), round(pose.position.y, 1)) for pose in poses]
    assert places == [(0.0, 3.0), (3.0, -4.5), (6.0, 3.0)]
    assert poses[1].orientation.z == pytest.approx(0.707, abs=0.01)
    stack.log_has("roslaunch", "3 participants have joined")

    tf = graph.hear("/tf", TFMessage)
    stack.wait(lambda: tf.last, "XTDrone's static_transform_publisher publishes")
    assert tf.last.transforms[0].child_frame_id.strip("/") == "iris_0/camera_link"

    for name in NAMES:  # setpoints are sent by wall time: a busy machine must not end OFFBOARD
        answer = graph.call(
            f"/{name}/mavros/param/set", ParamSet, param_id="COM_OF_LOSS_T", value=ParamValue(real=60.0)
        )
        assert answer.success
    script = stack.start("script", [sys.executable, str(REPOSITORY / "tests/offboard_script.py"), *NAMES])
    stack.wait(lambda: min(stack.height(i) for i in range(3)) > 1.5, "all are in the air", sim=90.0)
    assert script.end() == 0, script.output
    assert script.output.split() == ["landed:", *NAMES]
    for i in range(3):
        stack.wait_landed(i)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["second_sdf:=tailsitter"], "'tailsitter' is not known, a VTOL aircraft"),
        (["world:=$(find mavlink_sitl_gazebo)/worlds/moon.world"], "moon.world does not exist; there are ego_swarm"),
    ],
)
def test_what_cannot_fly_ends_the_launch_with_one_line(arguments: list[str], message: str, stack: Stack) -> None:
    worlds = str(STAND_INS / "mavlink_sitl_gazebo")
    words = [word.replace("$(find mavlink_sitl_gazebo)", worlds) for word in arguments]
    launch = stack.start("roslaunch", ["roslaunch", str(GENERATED), *words])
    launch.end(START_LIMIT)
    assert [line for line in launch.output.splitlines() if "FATAL" in line and message in line], launch.output


@pytest.mark.parametrize(
    ("file", "count"),
    [
        ("multi_vehicle.launch", 2),
        ("outdoor1.launch", 1),
        ("robocup.launch", 6),
        ("posix_sitl.launch", 1),
        ("mavros_posix_sitl.launch", 1),
    ],
)
def test_px4_s_launch_files_are_found_by_name(file: str, count: int) -> None:
    path = subprocess.run(["rospack", "find", "px4"], capture_output=True, text=True, check=True).stdout.strip()
    config = load_config_default([f"{path}/launch/{file}"], None, verbose=False, assign_machines=False)
    assert not config.config_errors
    names = [f"{node.namespace}{node.name}" for node in config.nodes]
    assert names.count("/simulator") == 1
    assert len([name for name in config.params if name.endswith("/ID_in_group")]) == count
    mavros = [name for name in names if name.endswith("mavros")]
    assert len(mavros) == (0 if file == "posix_sitl.launch" else count)
