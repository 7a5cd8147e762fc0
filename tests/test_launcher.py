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
def test_a_path_that_the_build_cannot_take_is_refused_at_once(tmp_path: Path, name: str) -> None:
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
def test_wrong_words_are_refused_with_what_is_allowed(
    tmp_path: Path, arguments: list[str], words: tuple[str, ...]
) -> None:
    run = launcher(tmp_path, *arguments)
    assert (run.returncode, run.stdout) == (2, "")
    for word in words:
        assert word in run.stderr
