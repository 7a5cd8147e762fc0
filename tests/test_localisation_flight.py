"""Relative localisation through the whole stack: a formation by ranges and bearings, two vehicles by ranges alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import START_LIMIT, WALL_LIMIT, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")


def test_followers_fly_a_formation_on_their_own_estimates(tmp_path: Path) -> None:
    wait_for_ports("iris:3")
    out = tmp_path / "run"
    command = [
        sys.executable, "-m", "xtdrone_interaction", "demo", "formation", "--n", "3", "--type", "iris_uwb_bearing",
        "--patterns", "triangle", "--processes", "shared", "--neighbours", "estimated", "--no-film", "--headless",
        "--out", str(out),
    ]  # fmt: skip
    environment = {k: v for k, v in os.environ.items() if k not in ("ROS_MASTER_URI", "DISPLAY")}
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=START_LIMIT + 3 * WALL_LIMIT, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["settings"]["neighbours"] == "estimated"
    assert all(pattern["steady_error_max"] < 0.3 for pattern in report["reconfigurations"])


def _simulator_is_up() -> bool:
    import rosgraph

    return bool(rosgraph.Master("/system_tests").hasParam("/lockstep/uri"))


def test_ranges_alone_tell_where_a_turning_neighbour_is(graph: Graph, tmp_path: Path) -> None:
    fleet, report = "iris_uwb:2", tmp_path / "report.json"
    wait_for_ports(fleet)
    stack = Stack(graph, tmp_path, fleet)
    try:
        stack.launch(
            "multi_vehicle.launch", f"vehicles:={fleet}", "uwb:=true", "speed:=0",
            "participants:=/mavros,/uwb,/localisation,/drone_script",
        )  # fmt: skip
        poll(_simulator_is_up, "roslaunch sets its parameters")
        stack.run("localisation", "xtdrone_perception", "relative_localisation.py", "iris_uwb", "0", "2")
        pilot = stack.start("pilot", [sys.executable, str(Path(__file__).with_name("ranging_pilot.py")), str(report)])
        assert pilot.end(START_LIMIT + WALL_LIMIT) == 0, pilot.output
    finally:
        stack.stop()
    found = json.loads(report.read_text())
    assert found["first"] < 22.0
    assert found["median"] < 0.15
    assert found["most"] < 0.6
    assert 0.1 < found["squared"] < 4.0  # 1 expected; correlated within a flight


@pytest.mark.parametrize("kind", ["iris", "iris_uwb"])
def test_a_type_that_measures_no_bearings_is_refused(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    from xtdrone_interaction import cli

    assert cli.main(["demo", "formation", "--type", kind, "--neighbours", "estimated"]) == 2
    words = f"needs a type whose UWB sensor measures bearings, as iris_uwb_bearing, not {kind!r}"
    assert words in capsys.readouterr().err
