"""Of all output, only pybullet's is kept from the terminal."""

from __future__ import annotations

import subprocess
import sys

import pytest

WORLD = """
print("before")
from xtdrone_common.fleet import StartPose
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_sim.physics.world import World
from xtdrone_worlds.worlds.catalogue import load_world
for _ in range(2):
    World(load_world("empty"), [load_vehicle("iris")], [StartPose(0.0, 0.0, 0.0)], 0.004).close()
print("after")
"""

OTHERS = """
import ctypes, os, sys
from xtdrone_sim.physics.quiet_pybullet import without_lines
c = ctypes.CDLL(None)
c.puts(b"first")
with without_lines([b"argv"]):
    c.puts(b"argv[0]=")
    c.puts(b"second")
    os.write(2, b"an error\\n")
c.puts(b"argv[0]= of somebody else")
"""


def _run(script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120)


def test_a_world_prints_nothing() -> None:
    done = _run(WORLD)
    assert done.stdout.split() == ["before", "after"]
    assert done.stderr == ""


def test_other_output_is_kept() -> None:
    done = _run(OTHERS)
    assert done.stdout.splitlines() == ["first", "second", "argv[0]= of somebody else"]
    assert done.stderr == "an error\n"


@pytest.mark.parametrize("closed", ["1>&-", "2>&-", "1>&- 2>&-"])
def test_a_process_without_a_terminal_can_do_it_too(closed: str) -> None:
    command = f"exec '{sys.executable}' -c 'from xtdrone_sim.physics.quiet_pybullet import connect; connect()' {closed}"
    assert subprocess.run(["bash", "-c", command], check=False, timeout=120).returncode == 0
