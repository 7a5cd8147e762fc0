"""The safety filter with a script that flies two vehicles into each other, and with the keyboard's topics."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from conftest import Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

import rosgraph
from xtdrone_msgs.msg import SafetyIntervention

DISTANCE = 1.5

EXCHANGE = """
import sys
import numpy as np
from std_msgs.msg import Float64MultiArray
from xtdrone_control import lockstep
from xtdrone_control.drone import connect_all

places = []
with connect_all() as swarm:
    hear = lambda message: places.append(np.array(message.data).reshape(-1, 6)[:, :3])
    lockstep.Subscriber("/xtdrone/swarm", Float64MultiArray, hear)
    swarm.arm()
    swarm.takeoff(3.0)
    goals = swarm.position[::-1].copy()
    swarm.go_to(goals)
    print("arrived", bool((abs(swarm.position - goals) < 0.5).all()))
    swarm.set_velocity([[0, 1.5, 0], [0, -1.5, 0]])
    swarm.wait(8.0)
track = np.array(places)
print("least", float(np.linalg.norm(track[:, 0] - track[:, 1], axis=1).min()))
"""


def fly(graph: Graph, folder: Path, *arguments: str) -> tuple[str, list[SafetyIntervention], bytes]:
    """Fly the script; return its output, all interventions and the file of checksums."""
    fleet = "iris:2"
    wait_for_ports(fleet)
    graph.forget()
    folder.mkdir()
    stack = Stack(graph, folder, fleet)
    digest = folder / "digest.txt"
    try:
        ears = [graph.hear(f"/iris_{i}/safety/intervention", SafetyIntervention) for i in range(2)]
        stack.launch("multi_vehicle.launch", f"vehicles:={fleet}", "rows:=1", "speed:=0", "poses:=[[0,0],[0,10]]",
                     f"digest:={digest}", *arguments)  # fmt: skip
        poll(lambda: rosgraph.Master("/system_tests").hasParam("/lockstep/uri"), "roslaunch starts a simulator")
        script = stack.start("script", [sys.executable, "-c", EXCHANGE])
        assert script.end() == 0, script.output
        return script.output, [message for ear in ears for message in ear.messages], digest.read_bytes()
    finally:
        stack.stop()


def least(output: str) -> float:
    return float(next(line.split()[1] for line in output.splitlines() if line.startswith("least")))


def test_vehicles_that_a_script_flies_into_each_other_stay_apart(graph: Graph, tmp_path: Path) -> None:
    safe = "safety:=true", f"safety_distance:={DISTANCE}", "participants:=/mavros,/drone_script,/safety_filter"
    output, interventions, _ = fly(graph, tmp_path / "safe", *safe)
    assert "arrived True" in output
    assert least(output) > DISTANCE
    corrected = [entry for entry in interventions if entry.corrected]
    assert {entry.cause for entry in corrected} == {"iris_0", "iris_1"}
    assert all(entry.excess == 0.0 for entry in corrected)
    assert min(entry.nearest for entry in corrected) > DISTANCE
