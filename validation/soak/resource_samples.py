"""Resources used by the processes of a soak, from Linux's /proc."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from benchmarks.process_use import PROC

PROCESSES = ("simulator", "mavros", "rosmaster", "rosout")
FIGURES = ("rss", "pss", "anonymous", "descriptors", "threads", "sockets")
"""Of each process: memory in bytes, and counts. ``anonymous`` is the part of pss that no file backs.

pss depends on how many other programs on the machine share a library's pages, so it is reported but not judged.
"""
COLUMNS = (
    "wall",
    "soak_time",
    "sim_time",
    "phase",
    "episode",
    "resting",
    "rtf",
    "cpu_per_second",
    "others",
    "participants",
    "children",
    "log_bytes",
    "warnings",
    "lost",
    *(f"{process}_{figure}" for process in PROCESSES for figure in FIGURES),
)


def figures(pid: int, proc: Path = PROC) -> dict[str, int]:
    """Return the figures of a process, see FIGURES.

    Raises:
        OSError: it has ended.
    """
    folder = proc / str(pid)
    status = dict(line.split(":", 1) for line in (folder / "status").read_text(encoding="utf-8").splitlines())
    rollup = (folder / "smaps_rollup").read_text(encoding="ascii").splitlines()
    links = []
    for entry in os.listdir(folder / "fd"):
        with suppress(OSError):  # closed in between
            links.append(os.readlink(folder / "fd" / entry))
    return {
        "rss": int(status["VmRSS"].split()[0]) * 1024,
        "pss": sum(int(line.split()[1]) * 1024 for line in rollup if line.startswith("Pss:")),
        "anonymous": sum(int(line.split()[1]) * 1024 for line in rollup if line.startswith("Pss_Anon:")),
        "descriptors": len(links),
        "threads": int(status["Threads"]),
        "sockets": sum(link.startswith("socket:") for link in links),
    }


def open_files(pid: int, proc: Path = PROC) -> set[str]:
    """Return the paths of the files that a process has open."""
    found = set()
    folder = proc / str(pid) / "fd"
    with suppress(OSError):  # it has ended
        for entry in os.listdir(folder):
            with suppress(OSError):
                found.add(os.readlink(folder / entry))
    return found


def folder_size(folders: Iterable[Path]) -> int:
    """Return the total size of the files in folders, bytes."""
    total = 0
    for folder in folders:
        for place, _, names in os.walk(folder):
            for name in names:
                with suppress(OSError):  # removed in between
                    total += os.lstat(os.path.join(place, name)).st_size
    return total


class SampleFile:
    """A CSV file with a line per sample, complete at any time.

    Attributes:
        rows: of all samples so far.
    """

    def __init__(self, path: Path) -> None:
        """Begin the file."""
        self.rows: list[dict[str, Any]] = []
        self._file: IO[str] = path.open("w", encoding="utf-8", newline="")
        self._writer = csv.DictWriter(self._file, COLUMNS)
        self._writer.writeheader()
        self._file.flush()

    def add(self, row: Mapping[str, Any]) -> None:
        """Write a line and flush it."""
        self.rows.append(dict(row))
        self._writer.writerow(row)
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
