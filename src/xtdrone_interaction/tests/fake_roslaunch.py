"""A roslaunch scripted by tests, and a query for its processes that still run."""

from __future__ import annotations

import os
from pathlib import Path


def install(folder: Path, program: str) -> str:
    """Write ``program`` as ``folder/bin/roslaunch`` and return a PATH on which it comes first."""
    fake = folder / "bin" / "roslaunch"
    fake.parent.mkdir()
    fake.write_text(program)
    fake.chmod(0o755)
    return f"{fake.parent}{os.pathsep}{os.environ['PATH']}"


def running(mark: str) -> list[str]:
    """Return the process ids whose command line holds ``mark``."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and mark in (entry / "cmdline").read_bytes().decode(errors="replace"):
                found.append(entry.name)
        except OSError:
            continue
    return found
