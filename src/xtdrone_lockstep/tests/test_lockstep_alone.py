"""The lockstep without the rest of the project: the example of docs/lockstep.md."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("rospy")
from ros_master import RosMaster

EXAMPLE = Path(__file__).parents[1] / "examples" / "lockstep_alone"
PATIENCE = 120.0  # s of wall time
LISTING = """
import sys
import xtdrone_lockstep.client.api, xtdrone_lockstep.server
print(*(name for name in sys.modules if name.startswith("xtdrone_")))
"""


@pytest.fixture
def master() -> Iterator[RosMaster]:
    """Run a master."""
    running = RosMaster()
    yield running
    running.close()


def fly(master: RosMaster) -> list[str]:
    """Run the example for 5 s of simulated time, and return what the plant prints."""

    def start(name: str, *arguments: str) -> subprocess.Popen[str]:
        environment = os.environ | {"ROS_MASTER_URI": master.uri, "PYTHONUNBUFFERED": "1"}
        command = [sys.executable, str(EXAMPLE / name), *arguments]
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)

    server = start("server.py", "2", "5")
    assert server.stdout is not None
    assert "0 of 2 participants" in server.stdout.readline()
    plant, controller = start("plant.py"), start("controller.py")
    texts = [process.communicate(timeout=PATIENCE)[0] for process in (plant, controller, server)]
    assert [process.returncode for process in (plant, controller, server)] == [0, 0, 0]
    return [line for line in texts[0].splitlines() if not line.startswith("[INFO]")]


def test_two_foreign_nodes_fly_the_same_in_each_run(master):
    first = fly(master)
    assert [line.split(" s:")[0] for line in first] == ["0", "1", "2", "3", "4", "5"]
    assert float(first[-1].split()[2]) == pytest.approx(1.0, abs=0.02)
    assert fly(master) == first


def test_the_lockstep_imports_only_the_common_ground_of_the_packages():
    done = subprocess.run([sys.executable, "-c", LISTING], capture_output=True, text=True, check=True, timeout=PATIENCE)
    packages = {name.split(".")[0] for name in done.stdout.split() if name.startswith("xtdrone_")}
    assert packages <= {"xtdrone_common", "xtdrone_lockstep", "xtdrone_native"}
