"""Scripts that fly by ``xtdrone_control.drone`` on the running system: in lockstep and free-running, one and three."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from conftest import Graph, Program, Stack, poll, wait_for_ports

pytest.importorskip("rospy")

import rosgraph

ONE = """
import rospy
from xtdrone_control.drone import DroneError, RejectedError, TimedOutError, connect

def failure(kind, call):
    try:
        call()
    except kind as error:
        print("failed:", error)

with connect("iris_0") as drone:
    failure(DroneError, lambda: drone.takeoff(2.0))
    drone.arm()
    drone.takeoff(1.5)
    failure(RejectedError, drone.disarm)
    failure(TimedOutError, lambda: drone.go_to(9, 3, 1.5, timeout=1.0))
    drone.go_to(2, 4, 1.5, heading=1.0)
    drone.set_velocity(1, 0, 0)
    drone.wait(2.0)
    drone.land()
    print("landed", drone.armed, 0.5 < drone.battery <= 1.0)
"""

THREE = """
import numpy as np
from xtdrone_control.drone import connect_all

with connect_all() as swarm:
    swarm.arm()
    swarm.takeoff(2.0)
    goals = swarm.position + [0, 3, 1]
    swarm.go_to(goals)
    print("error below 0.4 m:", bool((abs(swarm.position - goals) < 0.4).all()))
    swarm.set_velocity([[0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5]])
    swarm.wait(3.0)
    print("velocities:", bool((abs(swarm.velocity - np.eye(3) / 2) < 0.15).all()))
print("left in the air")
"""

FREE = """
from xtdrone_control.drone import connect

drone = connect("iris_1", lockstep=False, node="free_script")
print("mode", drone.mode)
drone.go_to(*(drone.position + [0, 0, 1]))
print("on the way", flush=True)
drone.go_to(400, 0, 5)
"""


@contextmanager
def running(graph: Graph, folder: Path, fleet: str, *arguments: str) -> Iterator[Stack]:
    wait_for_ports(fleet)
    graph.forget()
    stack = Stack(graph, folder, fleet)
    try:
        stack.launch("multi_vehicle.launch", f"vehicles:={fleet}", "participants:=/mavros,/drone_script", *arguments)
        poll(lambda: rosgraph.Master("/system_tests").hasParam("/lockstep/uri"), "roslaunch starts a simulator")
        yield stack
    finally:
        stack.stop()


def start(stack: Stack, name: str, script: str) -> Program:
    return stack.start(name, [sys.executable, "-c", script])


def lines(program: Program) -> list[str]:
    return [line for line in program.output.splitlines() if not line.startswith("[")]


def test_one_vehicle_flies_in_lockstep_and_failures_are_named(graph: Graph, tmp_path: Path) -> None:
    """That a script's flight is the same each time: test_watched_flight.py."""
    with running(graph, tmp_path, "iris:1", "speed:=0") as stack:
        script = start(stack, "script", ONE)
        assert script.end() == 0, script.output
        said = lines(script)
    failures = [line for line in said if line.startswith("failed: ")]
    assert failures[0] == "failed: iris_0: takeoff: the vehicle is not armed; call arm() first"
    assert failures[1].startswith("failed: iris_0: disarm: rejected (MAV_RESULT 1)")
    assert "not landed" in failures[1].lower()
    assert failures[2].startswith("failed: iris_0: go_to: ")
    assert failures[2].endswith(" m from the goal after 1 s")
    assert said[-1] == "landed False True"


def test_three_vehicles_then_one_free_running_that_is_interrupted(graph: Graph, tmp_path: Path) -> None:
    with running(graph, tmp_path, "iris:3", "speed:=10") as stack:
        script = start(stack, "script", THREE)
        assert script.end() == 0, script.output
        assert lines(script)[:2] == ["error below 0.4 m: True", "velocities: True"]
        assert script.output.count("holds position in AUTO.LOITER at (") == 3
        stack.wait_state(0, mode="AUTO.LOITER", armed=True)
        free = start(stack, "free", FREE)
        stack.log_has("free", "on the way")
        stack.pass_time(2.0)
        free.process.send_signal(signal.SIGINT)
        assert free.end() != 0
        assert "KeyboardInterrupt" in free.output
        assert "iris_1: holds position in AUTO.LOITER at (" in free.output
        stack.wait_state(1, mode="AUTO.LOITER", armed=True)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        ("connect('iris_7')", "iris_7: connect: not in the fleet: /xtdrone/fleet has iris_0, iris_1"),
        ("connect_all([])", "names: [] is not allowed"),
        ("connect('iris_0', timeout=1.0)", "no autopilot on /iris_0/mavros/state within 1 s; is its MAVROS running?"),
    ],
)
def test_connection_failures_are_reported(graph: Graph, tmp_path: Path, code: str, text: str) -> None:
    rosgraph.Master("/system_tests").setParam("/xtdrone/fleet", "iris:2")
    stack = Stack(graph, tmp_path)
    try:
        script = start(stack, "script", f"from xtdrone_control.drone import connect, connect_all\n{code}")
        assert script.end() == 1
        assert text in script.output
    finally:
        stack.stop()
        graph.forget_parameters()
