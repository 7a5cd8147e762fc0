"""``./xtdrone demo slam``: flights without GPS by lidar alone, whole and with a lidar that fails in flight."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import START_LIMIT, WALL_LIMIT

from xtdrone_interaction import cli
from xtdrone_interaction.missions.slam.cli import SCRIPT

pytest.importorskip("rospy")

from diagnostic_msgs.msg import DiagnosticStatus

PILOT = Path(__file__).with_name("slam_fault_pilot.py")


def fly(out: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the demo in a short flight."""
    variables = {k: v for k, v in os.environ.items() if k not in ("ROS_MASTER_URI", "DISPLAY", "ROS_LOG_DIR")}
    return subprocess.run(
        [
            sys.executable,
            "-m",
            "xtdrone_interaction",
            "demo",
            "slam",
            "--speed",
            "unlimited",
            "--out",
            str(out),
            *arguments,
        ],
        env={**variables, **environment},
        capture_output=True,
        text=True,
        timeout=START_LIMIT + 2 * WALL_LIMIT,
        check=False,
    )


def errors_said(bag: Path) -> list[str]:
    """Return the errors of the odometry on /diagnostics."""
    import rosbag

    with rosbag.Bag(str(bag)) as opened:
        messages = [message for _, message, _ in opened.read_messages(topics=["/diagnostics"])]
    said = [status for message in messages for status in message.status if status.name.endswith("_odometry")]
    assert said
    return [status.message for status in said if status.level >= DiagnosticStatus.ERROR]


def test_it_flies_and_comes_home_by_lidar_alone(tmp_path: Path) -> None:
    flown = fly(tmp_path / "run", "--world", "city:seed=2", "--seed", "3", "--height", "2", "--way", "12,0", "12,6")
    assert flown.returncode == 0, flown.stdout + flown.stderr
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["home_miss"] < 0.3
    first, aligned = report["odometry"]
    assert first["way"] > 25.0
    assert first["ate"] < 0.2
    assert aligned["ate"] < 0.05
    assert first["drift"] < 0.5
    assert (tmp_path / "run" / "path.png").stat().st_size > 10_000
    maps = {row["map"]: row for row in report["maps"]}
    octree = maps["map.bt"]
    assert octree["points"] > 5000
    assert octree["precision"] > 0.9
    assert octree["recall"] > 0.3
    assert octree["chamfer"] < 0.2
    assert maps["iris_slam_0/lidar_odometry/local_map"]["precision"] > 0.9


@pytest.mark.parametrize(
    ("sensor", "height", "way", "most"), [("laser", "1.2", "5,0", 0.1), ("rgbd", "1.5", "2,0", 0.3)]
)
def test_it_flies_by_a_2d_laser_and_by_a_camera(
    sensor: str, height: str, way: str, most: float, tmp_path: Path
) -> None:
    """Before it arms it stands for 2 s: a camera's images then repeat themselves, which is no fault."""
    pilot = tmp_path / "pilot.py"
    pilot.write_text(SCRIPT.read_text("utf-8").replace("drone.arm()", "drone.wait(2), drone.arm()"), "utf-8")
    flown = fly(tmp_path / "run", "--by", sensor, "--height", height, "--way", way, "--script", str(pilot))
    assert flown.returncode == 0, flown.stdout + flown.stderr
    assert not errors_said(tmp_path / "run" / "flight.bag")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["home_miss"] < 0.3
    assert report["odometry"][0]["way"] > 2.0 * float(way.split(",")[0])
    assert report["odometry"][0]["greatest"] < most


@pytest.mark.parametrize(
    "fault",
    ["0 frozen 0 scans do not change", "4 off 0 no scans arrive", "5 dropouts 0.999 too few points are seen"],
    ids=("frozen", "silent", "blind"),
)
def test_a_lidar_that_fails_is_named_and_the_vehicle_lands(fault: str, tmp_path: Path) -> None:
    """At rest by the failsafe; at 4 and 5 m/s the script brakes while the autopilot still knows its velocity."""
    flown = fly(tmp_path / "run", "--script", str(PILOT), SLAM_FAULT=fault)
    _, kind, _, text = fault.split(" ", 3)
    assert f"{kind}: {text}; landed" in flown.stdout, flown.stdout + flown.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--way", "3"], "way: '3' is not allowed; two comma-separated numbers in m, e.g. 20,-5"),
        (["--way", "-3,nan"], "way: '-3,nan' is not allowed"),
        (["--script", "nowhere.py"], "script: 'nowhere.py' is not allowed, an existing .py file"),
        (["--height", "0"], "'0' is not allowed, 1 to 50 m"),
    ],
)
def test_values_that_are_not_allowed_are_named(
    options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = cli.main(["demo", "slam", *options])
    except SystemExit as ended:  # argparse exits
        status = int(str(ended.code))
    assert status == 2
    assert words in capsys.readouterr().err
