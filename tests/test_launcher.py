"""The launcher `./xtdrone` in folders and with arguments that it rejects before any set-up."""

from __future__ import annotations

import os
import pty
import select
import shutil
import subprocess
from pathlib import Path

import pytest
from conftest import REPOSITORY


def launcher(
    folder: Path, *arguments: str, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a copy of the launcher that lies in a folder, in this process's environment by default."""
    folder.mkdir(exist_ok=True)
    for name in ("xtdrone", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, folder)
    shutil.copytree(REPOSITORY / "scripts", folder / "scripts")
    return subprocess.run(
        [folder / "xtdrone", *arguments],
        capture_output=True, text=True, stdin=subprocess.DEVNULL, env=environment,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["my drones", "it's", "a$b", "a(b)", "a:b", "a\\b", "a[b", "a]b", 'a"b', "tab\there"])
def test_a_path_that_the_build_does_not_support_is_rejected_at_once(tmp_path: Path, name: str) -> None:
    run = launcher(tmp_path / name, "setup")
    assert run.returncode == 1
    assert str(tmp_path / name) in run.stderr
    assert "move or clone it" in run.stderr
    assert run.stdout == ""
    assert not (tmp_path / name / ".setup").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fly"], ("'fly'", "demo, launch, sim, doctor, gcs")),
        (["setup", "now"], ("setup takes no arguments, got: now",)),
        (["demo"], ("demo needs a name", "formation")),
        (["demo", "formaton"], ("'formaton'", "formation simplified search")),
        (["demo", "formaton", "--help"], ("'formaton'", "formation simplified search")),
        (["help", "fly"], ("'fly'", "demo, launch, sim, doctor, gcs")),
    ],
)
def test_invalid_words_are_rejected_with_the_allowed_ones(
    tmp_path: Path, arguments: list[str], words: tuple[str, ...]
) -> None:
    run = launcher(tmp_path, *arguments)
    assert (run.returncode, run.stdout) == (2, "")
    for word in words:
        assert word in run.stderr


@pytest.mark.parametrize(
    ("arguments", "first", "contained"),
    [
        ("--help", "Usage: ./xtdrone COMMAND", "fly a demo: hello, formation, simplified, search"),
        ("demo --help", "Usage: ./xtdrone demo NAME", "UAVs take off, fly through formation patterns"),
        ("demo formation --help", "usage: xtdrone demo formation [-h] [--n N]", "--patterns NAMES"),
        ("demo formation --n 3 -h", "usage: xtdrone demo formation", "--patterns NAMES"),
        ("help demo search", "usage: xtdrone demo search", "--persons K"),
        ("bench --quick --help", "usage: xtdrone bench", "--baseline"),
        ("gcs --help", "usage: xtdrone gcs [-h] COMMAND", "takeoff"),
        ("gcs fence upload --help", "usage: xtdrone gcs fence upload", "--vehicle"),
        ("help sim", "usage: xtdrone sim [-h] COMMAND", "pause"),
        ("shell --help", "Usage: ./xtdrone shell", "a shell with the workspace"),
        ("test --help", "Usage: ./xtdrone test", "./xtdrone shell pytest --help"),
        ("setup --help", "Usage: ./xtdrone setup", "Set up only"),
        ("--version", "xtdrone 1.", ""),
    ],
)
def test_help_needs_neither_python_nor_a_set_up(tmp_path: Path, arguments: str, first: str, contained: str) -> None:
    tools = tmp_path / "tools"
    tools.mkdir()
    for tool in ("bash", "env", "readlink", "dirname", "cat", "sed"):  # a bare Debian has no other usable ones
        (tools / tool).symlink_to(f"/bin/{tool}")
    run = launcher(tmp_path, *arguments.split(), environment={"PATH": str(tools)})
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.startswith(first)
    assert contained in run.stdout
    assert not (tmp_path / ".setup").exists()


def test_too_low_a_limit_of_memory_is_rejected(tmp_path: Path) -> None:
    low = 'ulimit -v 300000; exec "$@"'
    run = subprocess.run(
        ["bash", "-c", low, "_", REPOSITORY / "xtdrone", "demo", "formation"],
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert (run.returncode, run.stdout) == (1, "")
    assert "ulimit -v, is 300000 kB; at least 500000 are needed" in run.stderr


def test_unwritable_folders_are_replaced() -> None:
    run = subprocess.run(
        ["bash", "-c", 'source "$0/scripts/env.bash"; echo "${TMPDIR-unset} $XDG_CACHE_HOME"', REPOSITORY],
        env={"PATH": "/usr/bin:/bin", "HOME": "/proc/self", "TMPDIR": "/proc/no"}, capture_output=True, text=True,
    )  # fmt: skip
    assert run.stdout.split() == ["unset", f"{REPOSITORY}/.setup/cache"], run.stderr
    assert "TMPDIR is /proc/no, which is not there" in run.stderr
    assert "/proc/self/.cache cannot be written to" in run.stderr


def test_jobs_of_a_shell_end_with_it_unless_they_are_disowned(tmp_path: Path) -> None:
    """Jobs that ignore a hang-up end too, with all their processes."""
    rc = f"source <(sed '/^source.*env.bash/d' {REPOSITORY}/scripts/shellrc.bash)"
    lines = (
        "(echo $BASHPID > group; sleep 600; true) &",
        "nohup sleep 600 > out 2>&1 & echo $! > hardened",
        "sleep 600 & echo $! > kept; disown",
        "until test -s group; do sleep 0.1; done; exit",
    )
    start = tmp_path / "rc"
    start.write_text(f"{rc}\n")
    master, slave = pty.openpty()
    shell = subprocess.Popen(
        ["bash", "--rcfile", start, "-i"],
        cwd=tmp_path,
        env={**os.environ, "HOME": str(tmp_path)},
        preexec_fn=lambda: os.login_tty(slave),
    )
    os.close(slave)
    os.write(master, "".join(f"{line}\n" for line in lines).encode())
    said = b""
    while shell.poll() is None or select.select([master], [], [], 0.0)[0]:
        if select.select([master], [], [], 0.1)[0]:
            try:
                said += os.read(master, 4096)
            except OSError:  # no process holds the terminal any more
                break
    os.close(master)
    group, hardened, kept = (int((tmp_path / name).read_text()) for name in ("group", "hardened", "kept"))
    try:
        assert b"ending what was started in this shell" in said
        for number in (group, hardened):
            with pytest.raises(ProcessLookupError):
                os.kill(number, 0)
        os.kill(kept, 0)
    finally:
        os.kill(kept, 9)
