"""Our stand-ins for packages of PX4, Gazebo and MAVROS, with the real ones in another workspace."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from conftest import REPOSITORY

OURS = {"mavros": str(REPOSITORY / "src/xtdrone_mavros/mavros")} | {
    name: str(REPOSITORY / "src/xtdrone_sim/stand_ins" / name)
    for name in ("px4", "gazebo_ros", "mavlink_sitl_gazebo", "media_export")
}


def found(prefix: Path | None, **settings: str) -> dict[str, str]:
    """Return the paths of our names with our workspace sourced, on top of another one if there is one."""
    hidden = ("ROS_PACKAGE_PATH", "CMAKE_PREFIX_PATH", "PYTHONPATH")
    environment = {key: value for key, value in os.environ.items() if key not in hidden} | settings
    if prefix is not None:
        environment["CMAKE_PREFIX_PATH"] = str(prefix)
    twice = f"source {REPOSITORY}/devel/setup.bash --extend;" * 2  # as .bashrc and a user's terminal do
    command = ["bash", "-c", f"{twice} rospack list"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    packages = dict(line.split(maxsplit=1) for line in run.stdout.splitlines())
    assert "xtdrone_sim" in packages
    return {name: place for name, place in packages.items() if name in OURS}


def test_real_packages_hide_ours(tmp_path: Path) -> None:
    (tmp_path / ".catkin").touch()
    words = "<version>1.0.0</version><description>.</description><maintainer email='a@b.c'>.</maintainer>"
    for name in OURS:
        share = tmp_path / "share" / name
        share.mkdir(parents=True)
        (share / "package.xml").write_text(f"<package><name>{name}</name>{words}<license>.</license></package>")
    assert found(None) == OURS
    assert found(tmp_path) == {name: str(tmp_path / "share" / name) for name in OURS}


def test_ours_can_be_switched_off() -> None:
    assert found(None, XTDRONE_STAND_INS="off") == {}
