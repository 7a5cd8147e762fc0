"""``./xtdrone demo hello``: two at once, as two users of one machine start them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY, START_LIMIT, WALL_LIMIT

from xtdrone_interaction import cli

pytest.importorskip("rospy")

HELLO = REPOSITORY / "src" / "xtdrone_control" / "examples" / "hello.py"
BROKEN = """\
from xtdrone_control.drone import connect

with connect("iris_0") as drone:
    drone.takeoff(2)
"""


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    """Start the demo as a user with a separate home."""
    home = folder.with_name(f"{folder.name}-home")
    home.mkdir()
    environment = {k: v for k, v in os.environ.items() if k not in ("ROS_MASTER_URI", "DISPLAY", "ROS_LOG_DIR")}
    cache = os.environ.get("XDG_CACHE_HOME", str(Path("~/.cache").expanduser()))  # the compiled kernels
    return subprocess.Popen(
        [sys.executable, "-m", "xtdrone_interaction", "demo", "hello", "--out", str(folder), *arguments],
        env={**environment, "HOME": str(home), "XDG_CACHE_HOME": cache},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=home,
    )


def test_two_at_once_choose_ports_of_their_own(tmp_path: Path) -> None:
    broken = tmp_path / "broken.py"
    broken.write_text(BROKEN)
    demos = [start(tmp_path / "first"), start(tmp_path / "second", "--script", str(broken))]
    outputs = [demo.communicate(timeout=START_LIMIT + WALL_LIMIT)[0] for demo in demos]
    assert [demo.returncode for demo in demos] == [0, 1], outputs
    first, second = outputs
    # the output has the script, each corner of the square, and the offer of a copy
    for number, line in enumerate(HELLO.read_text(encoding="utf-8").splitlines(), start=1):
        assert re.search(rf"^ *{number} {re.escape(line)} *$", first, re.MULTILINE), (line, first)
    assert len(re.findall(r"^  <iris_0: OFFBOARD, armed, at \(", first, re.MULTILINE)) == 4
    assert "--script my_flight.py" in first
    assert "takeoff: the vehicle is not armed; call arm() first" in second
    assert "broken.py has ended with status 1" in second
    instances = {(re.findall(r"^Instance (\d)", output, re.MULTILINE) or ["0"])[0] for output in outputs}
    masters = {re.findall(r"ROS master (\S+);", output)[0] for output in outputs}
    assert len(instances) == len(masters) == 2
    assert not (tmp_path / "first" / "master").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--script", "nowhere.py"], "script: 'nowhere.py' is not allowed, an existing .py file"),
        (["--world", "oudoor"], "world: 'oudoor' is unknown; there are city, countryside, "),
        (["--world", "nowhere.world"], "nowhere.world: No such file"),
        (["--instance", "9"], "9"),
    ],
)
def test_values_that_are_not_allowed_are_named(
    options: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = cli.main(["demo", "hello", *options])
    except SystemExit as ended:  # argparse exits
        status = int(str(ended.code))
    assert status == 2
    assert words in capsys.readouterr().err
