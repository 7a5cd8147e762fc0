"""octomap_server.py in flight: services, saved files, reset, and a map that fills its memory."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import START_LIMIT, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

import rospy
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from octomap_msgs.srv import GetOctomap
from roslib.packages import find_node
from std_srvs.srv import Empty

from xtdrone_planning.octree.octree_format import decode, read_file
from xtdrone_planning.octree.octree_messages import octree_of
from xtdrone_sim.rays.scene import RayScene
from xtdrone_sim.rays.surface_points import distances_from
from xtdrone_worlds.worlds.catalogue import load_world

FLEET = "iris_3d_lidar:1"
NAME = "iris_3d_lidar_0"
WORLD = "indoor:seed=1"


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path_factory.mktemp("octomap"), FLEET)
    try:
        stack.launch(
            "multi_vehicle.launch", f"vehicles:={FLEET}", f"world:={WORLD}", "poses:=[[22, 5]]", "lidars:=true",
            "speed:=0", "participants:=4",
        )  # fmt: skip
        poll(lambda: rospy.has_param("/lockstep/uri"), "roslaunch sets its parameters")
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris_3d_lidar", "0")
        stack.run(
            "octomap", "xtdrone_planning", "octomap_server.py", "iris_3d_lidar", "0", "_memory:=2", "_interval:=0.2"
        )
        stack.wait(lambda: stack.pose(0) and stack.time > 0.0, "the simulation runs", wall=START_LIMIT)
        stack.wait_state(0)
        yield stack
    finally:
        stack.stop()


def text_of(message: DiagnosticArray | None) -> str:
    found = [status.message for status in message.status if status.name == f"{NAME}: octomap"] if message else []
    return found[0] if found else ""


def voxels(stack: Stack) -> NDArray[np.float64]:
    """Return the centres of the map's occupied voxels, (n, 3) m in map."""
    return decode(octree_of(stack.graph.call(f"/{NAME}/octomap_binary", GetOctomap).map)).middles()


def test_the_map_is_that_of_the_world_until_its_memory_is_full(stack: Stack, tmp_path: Path) -> None:
    graph = stack.graph
    reports = graph.hear("/diagnostics", DiagnosticArray)
    stack.fly(0, 1.2)
    middles = voxels(stack)
    assert len(middles) > 500
    surfaces = RayScene(load_world(WORLD).models).layout.trees.surfaces
    assert np.mean(distances_from(surfaces, middles, 5.0) < 0.25) > 0.95  # voxels of 0.2 m, noise of the estimate

    file = tmp_path / "map.ot"
    saver = find_node("xtdrone_planning", "octomap_saver.py")[0]
    run = subprocess.run([sys.executable, saver, str(file), NAME], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stdout + run.stderr
    assert len(read_file(file).middles()) >= 0.9 * len(middles)

    stack.wait(
        lambda: any("the map is full: 2 MB; new voxels are dropped" in text_of(m) for m in reports.messages),
        "the map is full",
        sim=60.0,
    )
    graph.call("/gazebo/pause_physics", Empty)  # a single scan fills the map again
    graph.call(f"/{NAME}/octomap_server/reset", Empty)
    assert len(voxels(stack)) == 0
    graph.call("/gazebo/unpause_physics", Empty)
    stack.wait(lambda: len(voxels(stack)) > 100, "it maps again", sim=30.0)
    assert stack.state(0).mode == "OFFBOARD"  # the flight is not affected
