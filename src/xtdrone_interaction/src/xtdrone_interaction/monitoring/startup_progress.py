"""Progress of a starting launch, read from its logs. ROS is not needed.

A line that has not been logged before is progress. Time stamps and numbers of seconds are ignored in the comparison, so
that a node that repeats a message makes no progress, but each additional participant does. The compilation of a kernel
is progress for its whole duration.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

_PREFIX = re.compile(r"^\[[^\]]*\]\[\w+\] [\d-]+ [\d:,]+: |^\[\w+\] \[[\d., ]+\]: |^\[ ?\w+\] \[[\d.]+\]: ")
_SECONDS = re.compile(r"\b\d+(\.\d+)? s\b")
_COLOURS = re.compile(r"\x1b\[[0-9;]*m|\x1b\][^\x07]*\x07")
_OWN = ("process[rosout-", "process[master")
_MOST = 1 << 20  # bytes read of a file at a time
_MOST_SEEN = 200_000  # stored lines
_COMPILING = re.compile(r"simulator: (compiling kernels: .*)")
_COMPILED = re.compile(r"simulator: kernel compiled: ")
_RUNS = re.compile(r"simulator: .* (is|are) ready, time runs")
_JOINED = re.compile(r"simulator: (\d+) participants have joined")
_STARTED = re.compile(r"^process\[[^\]]+-\d+\]: started with pid")
_WITHOUT = re.compile(r"simulator: time starts without all participants.*")


class Startup:
    """Reads the logs of a launch.

    Attributes:
        compiling: the simulator's message while it compiles a kernel, else empty.
        runs: whether the simulator has started time.
        joined: number of participants at the start of time; None before that.
        started: number of nodes started by roslaunch, without those of its own master (rosout).
        incomplete: the simulator's message if it has started time without some participants, else empty.
    """

    def __init__(self, folder: Path) -> None:
        """Prepare to read the logs in ``folder`` from their beginning."""
        self._folder = folder
        self._read: dict[str, int] = {}
        self._seen: set[str] = set()
        self.compiling = ""
        self.runs = False
        self.joined: int | None = None
        self.started = 0
        self.incomplete = ""

    def update(self) -> bool:
        """Read the new lines and return whether there was progress."""
        moves = False
        for path in self._files():
            for line in self._lines(path):
                text = _SECONDS.sub("# s", _PREFIX.sub("", line))
                if text not in self._seen and len(self._seen) < _MOST_SEEN:
                    self._seen.add(text)
                    moves = True
                self._understand(line)
        return moves or bool(self.compiling)

    def _understand(self, line: str) -> None:
        if _STARTED.search(line) and not line.startswith(_OWN):
            self.started += 1
        if "simulator: " not in line:
            return
        compiling = _COMPILING.search(line)
        joined = _JOINED.search(line)
        without = _WITHOUT.search(line)
        if compiling:
            self.compiling = compiling[1]
        elif _COMPILED.search(line):
            self.compiling = ""
        elif _RUNS.search(line):
            self.runs = True
        elif joined:
            self.joined = int(joined[1])
        elif without:
            self.incomplete = without[0]

    def _files(self) -> Iterator[str]:
        for folder, _, names in os.walk(self._folder):  # without links: roslaunch creates one to its latest logs
            for name in names:
                if name.endswith(".log"):
                    yield os.path.join(folder, name)

    def _lines(self, path: str) -> list[str]:
        """Return the complete new lines of a file."""
        begin = self._read.get(path, 0)
        try:
            with open(path, "rb") as file:
                file.seek(begin)
                data = file.read(_MOST)
        except OSError:  # removed in the meantime
            return []
        whole = data[: data.rfind(b"\n") + 1] or (data if len(data) == _MOST else b"")
        self._read[path] = begin + len(whole)
        return _COLOURS.sub("", whole.decode("utf-8", errors="replace")).splitlines()
