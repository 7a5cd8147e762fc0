"""``./xtdrone demo forest``: a flight through trees in lockstep, its report, and values that are not allowed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import START_LIMIT, WALL_LIMIT, wait_for_ports

from xtdrone_interaction import cli

pytest.importorskip("rospy")

RADIUS = 0.4  # m, of the vehicle with its rotors


def fly(folder: Path, *arguments: str) -> tuple[int, str]:
    """Run the demo; return exit status and output."""
    command = [sys.executable, "-m", "xtdrone_interaction", "demo", "forest", "--headless", "--out", str(folder)]
    run = subprocess.run(
        [*command, *arguments], capture_output=True, text=True, timeout=START_LIMIT + 2 * WALL_LIMIT, check=False
    )
    return run.returncode, run.stdout + run.stderr


def test_a_uav_flies_through_trees_and_the_report_says_how(tmp_path: Path) -> None:
    wait_for_ports("iris:1")
    status, output = fly(tmp_path / "run", "--seed", "2", "--goal", "38,5")
    assert status == 0, output
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    vehicle = report["vehicles"]["iris_3d_lidar_0"]
    assert vehicle["outcome"] == "arrived"
    assert vehicle["clearance"] > RADIUS
    assert vehicle["straight"] == pytest.approx(24.0, abs=0.5)
    assert vehicle["path"] >= vehicle["straight"]
    assert vehicle["time"] > vehicle["straight_time"]
    assert vehicle["mean_speed"] > 1.5
    assert report["collisions"] == report["shortcomings"] == []
    assert report["timings"]["iris_3d_lidar_0"]["plan"]["count"] > 5
    assert (tmp_path / "run" / "map.png").stat().st_size > 10_000
    assert (tmp_path / "run" / "flight.mp4").stat().st_size > 10_000
    assert "arrived" in output
    assert "flight.mp4" in output
    warned = (tmp_path / "run" / "logs" / "roslaunch.log").read_text()
    assert "Arming denied" in warned  # of PX4, so that warnings are there
    assert ": planner: " not in warned


def test_a_formation_passes_trees_and_forms_again(tmp_path: Path) -> None:
    wait_for_ports("iris:1")
    status, output = fly(
        tmp_path / "run", "--formation", "circle", "--n", "3", "--leader-speed", "2", "--seed", "1", "--goal", "42,5",
        "--world", "forest:seed=1,density=0.1,length=48,width=30,trunks=true",
    )  # fmt: skip
    assert status == 0, output
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert [vehicle["outcome"] for vehicle in report["vehicles"].values()] == ["arrived"] * 3
    assert RADIUS < min(vehicle["clearance"] for vehicle in report["vehicles"].values()) < 2.0
    assert report["least_distance"] > 2 * RADIUS
    assert report["collisions"] == report["shortcomings"] == []
    formation = report["formation"]
    assert formation["pattern"] == "circle"
    assert formation["before"]["mean"] < 0.2
    assert 0.1 < formation["during"]["mean"] < 2.0
    assert formation["after"]["mean"] < 0.3
    assert formation["after"]["most"] < 0.4
    assert any(file.stat().st_size > 10_000 for file in (tmp_path / "run").glob("flight.*") if file.suffix != ".bag")
    assert "Formation circle, error: before the way" in output


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--goal", "3"], "2 or 3 comma-separated numbers"),
        (["--start", "a,b"], "2 comma-separated numbers"),
        (["--sensor", "radar"], "radar"),
        (["--planner", "dijkstra"], "dijkstra"),
        (["--speed-limit", "0"], "0.2 to 15 m/s"),
        (["--world", "forrest"], "'forrest' is unknown"),
        (["--formation", "circle"], "n: 1 is not allowed with --formation, 2 to 12"),
        (["--formation", "hexagon", "--n", "3"], "hexagon"),
        (["--formation", "pyramid", "--n", "3"], "its slots are at 0 to 0 m; 0.8 to 5 m (--highest)"),
        (["--formation", "circle", "--n", "3", "--follower", "mine.py"], "follower: 'mine.py' is no FILE.py[:CLASS]"),
        (["--follower", __file__], "is not allowed without --formation"),
    ],
)
def test_values_that_are_not_allowed_are_named(
    options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = cli.main(["demo", "forest", *options])
    except SystemExit as ended:  # argparse exits
        status = int(str(ended.code))
    assert status == 2
    assert words in capsys.readouterr().err
