"""`./xtdrone` itself, in places and with words that it refuses before it sets anything up."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from conftest import REPOSITORY


def launcher(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a copy of the launcher that lies in a folder."""
    folder.mkdir(exist_ok=True)
    shutil.copy(REPOSITORY / "xtdrone", folder)
    shutil.copytree(REPOSITORY / "scripts", folder / "scripts")
    return subprocess.run([folder / "xtdrone", *arguments], capture_output=True, text=True, stdin=subprocess.DEVNULL)


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
        (["fly"], ("'fly'", "demo, launch, sim, gcs")),
        (["setup", "now"], ("setup takes no arguments, got: now",)),
        (["demo"], ("demo needs a name", "formation")),
        (["demo", "formaton"], ("'formaton'", "formation simplified search")),
    ],
)
def test_invalid_words_are_rejected_with_the_allowed_ones(
    tmp_path: Path, arguments: list[str], words: tuple[str, ...]
) -> None:
    run = launcher(tmp_path, *arguments)
    assert (run.returncode, run.stdout) == (2, "")
    for word in words:
        assert word in run.stderr


@pytest.mark.parametrize("arguments", [["help", "bench"], ["bench", "--quick", "--help"], ["demo", "formation", "-h"]])
def test_help_is_printed_without_a_set_up(tmp_path: Path, arguments: list[str]) -> None:
    """A workspace that was set up once, of which nothing is current, since it has no stamps."""
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "python").write_text('#!/bin/sh\necho "python $@"\n')
    (tmp_path / ".venv" / "bin" / "python").chmod(0o755)
    (tmp_path / "devel").mkdir()
    (tmp_path / "devel" / "setup.bash").touch()
    run = launcher(tmp_path, *arguments)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("python -m ")
    assert not (tmp_path / ".setup" / "logs").exists()


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
