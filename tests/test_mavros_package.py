"""Our package `mavros`, which has MAVROS's programs, beside a real MAVROS in another workspace."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from conftest import REPOSITORY

OURS = str(REPOSITORY / "src/xtdrone_control/mavros")


def found(prefix: Path | None) -> str:
    """Return where the package is found with our workspace sourced, and another one below it if there is one."""
    hidden = ("ROS_PACKAGE_PATH", "CMAKE_PREFIX_PATH", "PYTHONPATH")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    if prefix is not None:
        environment["CMAKE_PREFIX_PATH"] = str(prefix)
    twice = f"source {REPOSITORY}/devel/setup.bash --extend;" * 2  # as .bashrc and its reader do
    command = ["bash", "-c", f"{twice} rospack find mavros"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return run.stdout.strip()


@pytest.fixture
def real(tmp_path: Path) -> Path:
    """An installed workspace that has MAVROS."""
    share = tmp_path / "share" / "mavros"
    share.mkdir(parents=True)
    (tmp_path / ".catkin").touch()
    words = "<version>1.0.0</version><description>.</description><maintainer email='a@b.c'>.</maintainer>"
    (share / "package.xml").write_text(f"<package><name>mavros</name>{words}<license>.</license></package>")
    return tmp_path


def test_a_real_mavros_hides_ours(real: Path) -> None:
    assert found(None) == OURS
    assert found(real) == str(real / "share" / "mavros")
