"""A user's own world in the running simulator: its messages, its listing, its collisions; a faulty one is rejected."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rosgraph
from conftest import Graph, Program, Stack, wait_for_ports
from gazebo_msgs.msg import ModelStates

FLEET = "iris:1"
WORLD = """<sdf version="1.6"><world name="table">
  <gravity>0 0 -9.8</gravity>
  <model name="table"><static>{static}</static><pose>0 3 0.02 0 0 0</pose>
    <link name="link"><collision name="c"><geometry><box><size>40 40 0.04</size></box></geometry></collision></link>
  </model>
</world></sdf>
"""
Start = Callable[..., Program]


@pytest.fixture
def stack(graph: Graph, tmp_path: Path) -> Iterator[Stack]:
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path, FLEET)
    yield stack
    stack.stop()


@pytest.fixture
def start(stack: Stack) -> Start:
    def run(world: Path, *arguments: str) -> Program:
        settings = (f"_world:={world}", f"_fleet:={FLEET}", "_speed:=5", *arguments)
        return stack.run("simulator", "xtdrone_sim", "simulator.py", *settings)

    return run


def test_a_world_of_ones_own(stack: Stack, start: Start, tmp_path: Path) -> None:
    world = tmp_path / "table.world"
    world.write_text(WORLD.format(static="true"))
    start(world, "_poses:=[[0, 3, 0.2]]")
    states = stack.graph.hear("/gazebo/model_states", ModelStates)
    stack.wait(lambda: states.last, "model states", wall=200.0)
    assert states.last.name == ["ground_plane", "iris_0", "table"]
    assert (states.last.pose[2].position.y, states.last.pose[2].position.z) == (3.0, 0.02)
    assert rosgraph.Master("/system_tests").getParam("/xtdrone/world") == str(world)
    stack.log_has("simulator", "collision of iris_0 and table")
    stack.wait(lambda: 0.08 < stack.height(0) < 0.15, "the vehicle stands on the table")


def test_a_start_in_the_world_is_refused(start: Start, tmp_path: Path) -> None:
    world = tmp_path / "table.world"
    world.write_text(WORLD.format(static="true"))
    simulator = start(world, "_poses:=[[0, 3]]")
    assert simulator.end(200.0) == 1
    assert "iris_0: the start is not free: its body, centred at 0.00 3.00" in simulator.output
    assert "inside 'table'" in simulator.output


def test_a_world_that_cannot_be_used(start: Start, tmp_path: Path) -> None:
    world = tmp_path / "wrong.world"
    world.write_text(WORLD.format(static="perhaps"))
    simulator = start(world)
    assert simulator.end(200.0) == 1
    assert f"{world}: line 3: <static>: 'perhaps' is not allowed, true or false" in simulator.output
