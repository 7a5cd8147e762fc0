"""The tutorials of docs/tutorials, run as written.

A tutorial's fenced blocks run in order and in one folder:

- ``sh`` is run by ``bash -euo pipefail``;
- a language and a file name, as ``python my_follower.py`` or ``yaml vee.yaml``, becomes that file;
- ``python`` alone is run as a script;
- ``text`` and ``console`` are for the reader.

The folder holds ``./xtdrone`` without its set-up, and the repository's folders that tutorials use.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import REPOSITORY, free_port, wait_for_ports

TUTORIALS = sorted((REPOSITORY / "docs" / "tutorials").glob("*.md"))
LIMIT = 600.0  # s of wall time for one block
_FENCE = re.compile(r"^```(\w+)(?: +(\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_SHOWN = ("text", "console")
_LAUNCHER = """#!/bin/sh
exec python -m xtdrone_interaction "$@"
"""


def blocks(text: str) -> list[tuple[str, str, str]]:
    """Return language, file name (empty where there is none) and contents of a tutorial's fenced blocks."""
    return [(match[1], match[2] or "", match[3]) for match in _FENCE.finditer(text)]


def make_folder(folder: Path) -> None:
    """Copy into a folder the files that a tutorial expects around it."""
    launcher = folder / "xtdrone"
    launcher.write_text(_LAUNCHER, encoding="utf-8")
    launcher.chmod(0o755)
    for name in ("launch", "docs", "src", "training"):
        (folder / name).symlink_to(REPOSITORY / name)


def run(command: list[str], folder: Path, environment: dict[str, str]) -> tuple[int, str]:
    """Run one block; return exit status and output. Processes that it leaves running are ended, and the test fails."""
    log = folder / "output.txt"
    with (
        open(log, "w", encoding="utf-8") as output,
        subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        ) as process,
    ):
        try:
            status = process.wait(LIMIT)
        except subprocess.TimeoutExpired:
            status = -signal.SIGALRM
        finally:
            left = _end_group(process.pid)
    text = log.read_text(encoding="utf-8", errors="replace")
    return (1, f"{text}\nleft processes running") if left and status == 0 else (status, text)


def _end_group(group: int) -> bool:
    """Kill the remaining processes of a group; return whether there were any."""
    try:
        os.killpg(group, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def test_fenced_blocks_are_told_apart() -> None:
    text = "a\n```sh\nls\n```\n\n```python a.py\nx = 1\n```\n```text\nout\n```\n"
    assert blocks(text) == [("sh", "", "ls\n"), ("python", "a.py", "x = 1\n"), ("text", "", "out\n")]


@pytest.mark.timeout(4 * LIMIT)
@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_runs_as_it_is_written(tutorial: Path, tmp_path: Path) -> None:
    wait_for_ports("iris:4")
    make_folder(tmp_path)
    environment = {
        **os.environ,
        "ROS_MASTER_URI": f"http://127.0.0.1:{free_port()}",
        "ROS_IP": "127.0.0.1",
        "ROS_LOG_DIR": str(tmp_path / "ros"),
        "PYTHONUNBUFFERED": "1",
    }
    found = blocks(tutorial.read_text(encoding="utf-8"))
    assert any(language == "sh" for language, _, _ in found), f"{tutorial}: nothing to run"
    for number, (language, name, contents) in enumerate(found, 1):
        if language in _SHOWN:
            continue
        if name:
            (tmp_path / name).write_text(contents, encoding="utf-8")
            continue
        assert language in ("sh", "python"), f"{tutorial}, block {number}: language {language!r} is not known here"
        program = ["bash", "-euo", "pipefail"] if language == "sh" else [sys.executable]
        status, output = run([*program, "-c", contents], tmp_path, environment)
        assert status == 0, f"{tutorial}, block {number}:\n{contents}\nstatus {status}\n{output[-6000:]}"
