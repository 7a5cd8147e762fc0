"""pyproject.toml states the version, every other file repeats it; as a program, write it into those files."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
VERSION: str = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
_PATTERNS = {"package.xml": r"(?<=<version>)[^<]*(?=</version>)", "CITATION.cff": r"(?m)(?<=^version: ).*$"}
_FILES = [Path("CITATION.cff"), *(path.relative_to(ROOT) for path in sorted(ROOT.glob("src/**/package.xml")))]


@pytest.mark.parametrize("path", _FILES, ids=str)
def test_each_file_repeats_the_version(path: Path) -> None:
    assert re.findall(_PATTERNS[path.name], (ROOT / path).read_text()) == [VERSION]


def test_the_launcher_prints_the_version() -> None:
    run = subprocess.run([ROOT / "xtdrone", "--version"], capture_output=True, text=True, check=True)
    assert run.stdout == f"xtdrone {VERSION}\n"


if __name__ == "__main__":
    for path in _FILES:
        text = (ROOT / path).read_text()
        (ROOT / path).write_text(re.sub(_PATTERNS[path.name], VERSION, text))
