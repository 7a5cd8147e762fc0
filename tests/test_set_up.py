"""The set-up script: interrupted at any moment, beside another one, and with everything installed."""

from __future__ import annotations

import fcntl
import os
import random
import shutil
import signal
import subprocess
import time
import zipfile
from pathlib import Path

import pytest
from conftest import REPOSITORY, poll

PACKAGES = 4
FILES = 400  # in each package, so that pip takes a while to install it
LIMIT = 60.0  # s of wall time for one set-up


def make_wheel(folder: Path, number: int) -> str:
    """Write a wheel of many small modules; return its requirement."""
    name, info = f"part{number}", f"part{number}-1.0.dist-info"
    files = {f"{name}/m{k}.py": f"VALUE = {k}\n" for k in range(FILES)}
    files[f"{name}/__init__.py"] = "".join(f"from . import m{k}\n" for k in range(FILES))
    files[f"{info}/METADATA"] = f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
    files[f"{info}/WHEEL"] = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    files[f"{info}/RECORD"] = "".join(f"{file},,\n" for file in files)
    with zipfile.ZipFile(folder / f"{name}-1.0-py3-none-any.whl", "w") as wheel:
        for file, content in files.items():
            wheel.writestr(file, content)
    return f"{name}==1.0"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A built repository whose requirements are small wheels, and which needs no Debian package."""
    shutil.copytree(REPOSITORY / "scripts", tmp_path / "scripts", ignore=shutil.ignore_patterns("packages"))
    (tmp_path / "scripts/packages").mkdir()
    (tmp_path / "scripts/packages/none.txt").write_text("coreutils\n")
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    (tmp_path / "requirements.txt").write_text("\n".join(make_wheel(wheels, k) for k in range(PACKAGES)) + "\n")
    return tmp_path


def start(root: Path) -> subprocess.Popen[str]:
    """Start the part of the set-up that creates the virtual environment, in its own process group."""
    built = "is_built() { :; }; are_kernels_prepared() { :; }"
    begin = f'set -euo pipefail; root="{root}"; source "$root/scripts/install_and_build.bash"'
    script = f"{begin}; {built}; set_up demo; echo ready"
    environment = os.environ | {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(root / "wheels")}
    return subprocess.Popen(
        ["bash", "-c", script],
        env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip


def finish(process: subprocess.Popen[str]) -> str:
    output, _ = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, output
    assert output.endswith("ready\n")
    return output


def is_whole(root: Path) -> bool:
    """Return whether every module of every package can be imported."""
    command = [root / ".venv/bin/python", "-c", "import part0, part1, part2, part3; print(part3.m399.VALUE)"]
    run = subprocess.run(command, capture_output=True, text=True)
    return (run.returncode, run.stdout) == (0, "399\n")


def believes_to_be_ready(root: Path) -> bool:
    """Return whether the next set-up would leave the virtual environment as it is."""
    script = f'root="{root}"; source "$root/scripts/install_and_build.bash"; has_venv && has_python requirements'
    return subprocess.run(["bash", "-c", script], capture_output=True).returncode == 0


def test_a_set_up_killed_at_any_moment_is_repaired_by_the_next_one(root: Path) -> None:
    began = time.monotonic()
    finish(start(root))
    duration = time.monotonic() - began
    moments = random.Random(1)
    for number in range(20):
        if number % 5 == 0:  # from nothing; otherwise from the state left by the kill before
            shutil.rmtree(root / ".venv")
        process = start(root)
        try:
            process.wait(moments.uniform(0.0, duration))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        assert not believes_to_be_ready(root) or is_whole(root)
        if number % 5 == 4:
            finish(start(root))
            assert is_whole(root)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_pip_ends_the_set_up_and_is_noticed(root: Path, number: signal.Signals) -> None:
    """Ctrl-C reaches the whole group; after a kill of pip alone, its parent reports the failure."""
    process = start(root)
    log = root / ".setup/logs/pip-requirements.log"
    poll(lambda: log.is_file() and "Installing collected packages" in log.read_text(), "pip installs", LIMIT)
    if number is signal.SIGINT:
        os.killpg(process.pid, number)
    else:
        subprocess.run(["pkill", "-KILL", "-g", str(process.pid), "-f", "pip install"], check=True)
    process.communicate(timeout=LIMIT)
    assert process.returncode != 0
    assert not believes_to_be_ready(root)
    assert "an installation was interrupted" in finish(start(root))
    assert is_whole(root)


def test_an_interrupted_pip_is_noticed(root: Path) -> None:
    finish(start(root))
    (root / ".venv/.requirements.installed").unlink()
    (root / ".venv/lib/python3.11/site-packages/part2/m7.py").unlink()  # pip considers the package complete
    (root / ".venv/.pip-at-work").touch()
    assert "an installation was interrupted" in finish(start(root))
    assert is_whole(root)
    assert "xtdrone:" not in finish(start(root))


def test_what_is_set_up_does_not_wait_for_another_set_up(root: Path) -> None:
    finish(start(root))
    with open(root / ".setup/lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert finish(start(root)) == "ready\n"
        (root / "requirements.txt").write_text("part0==1.0\n")
        waiting = start(root)
        assert waiting.stdout is not None
        assert "another set-up is running" in waiting.stdout.readline()
        fcntl.flock(lock, fcntl.LOCK_UN)
    assert "installing what is missing" in finish(waiting)


def test_files_of_a_killed_build_are_removed(root: Path) -> None:
    for name in ("build/old.o", "devel/include/old.h"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    marker = root / ".setup/make-at-work"
    marker.parent.mkdir()
    marker.touch()
    new = [root / "build/new.o", root / "devel/include/new.h"]
    poll(lambda: _touched_later(new, marker), "files that are newer", 10.0)
    script = f'set -eu; root="{root}"; source "$root/scripts/install_and_build.bash"; remove_unfinished'
    subprocess.run(["bash", "-c", script], check=True)
    assert sorted(p.name for p in root.glob("[bd]*/**/*.[oh]")) == ["old.h", "old.o"]


def _touched_later(files: list[Path], than: Path) -> bool:
    for file in files:
        file.touch()
    return all(file.stat().st_mtime_ns > than.stat().st_mtime_ns for file in files)
