"""A simulator that fails in flight: its participants, in Python and in C++, end with an error too."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import REPOSITORY, Graph, Stack, wait_for_ports

pytest.importorskip("rospy")

FLEET = "iris:1"
SIMULATOR = """
import sys
from xtdrone_sim.runtime import full_simulation


class Bursting(full_simulation.FullSimulation):
    def advance(self, until_us):
        super().advance(until_us)
        if self.time_us > 200_000:
            raise RuntimeError("the plant\\nhas burst")


full_simulation.FullSimulation = Bursting
sys.exit(full_simulation.main())
"""


@pytest.fixture
def stack(graph: Graph, tmp_path: Path) -> Iterator[Stack]:
    graph.forget()
    wait_for_ports(FLEET)
    stack = Stack(graph, tmp_path, FLEET)
    yield stack
    stack.stop()
    graph.forget()


def test_participants_of_a_simulator_that_fails_end_with_an_error(stack: Stack) -> None:
    import rosgraph

    idle = shutil.which("lockstep_idle", path=str(REPOSITORY / "devel" / "lib" / "xtdrone_lockstep"))
    assert idle is not None, "the workspace is not built"
    settings = ("_participants:=/python,/cpp", f"_fleet:={FLEET}", "_speed:=0")
    simulator = stack.start("simulator", [sys.executable, "-c", SIMULATOR, *settings])
    rosgraph.Master("/system_tests").setParam("/lockstep/wait", True)
    python = stack.run("python", "xtdrone_lockstep", "lockstep_idle.py", "python", "30")
    cpp = stack.start("cpp", [idle, "cpp", "30"])
    assert simulator.end() == 1
    assert "RuntimeError: the plant" in simulator.output
    for participant in (python, cpp):
        assert participant.end() == 1
        assert "has ended with an error: the simulation has failed: RuntimeError: the plant\\nhas burst" in (
            participant.output
        ), participant.output
