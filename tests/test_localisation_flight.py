"""A formation whose followers know the others by ranges and bearings alone, through the whole stack."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import START_LIMIT, WALL_LIMIT, wait_for_ports

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


def test_a_type_without_a_sensor_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    from xtdrone_interaction import cli

    assert cli.main(["demo", "formation", "--neighbours", "estimated"]) == 2
    assert "needs a type with a UWB sensor, as iris_uwb_bearing, not 'iris'" in capsys.readouterr().err
