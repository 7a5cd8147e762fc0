"""How a launch gets on while it starts, as its logs tell. No ROS is needed.

What moves: a line that no log had before. Time stamps and numbers of seconds do not make a line new, so a node that
repeats itself does not move; one more participant that has joined does. A kernel that is being compiled moves too, for
as long as it takes.
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
_MOST = 1 << 20  # bytes of one file in one look
_MOST_SEEN = 200_000  # lines that are remembered
_COMPILING = re.compile(r"simulator: (compiling kernels: .*)")
_COMPILED = re.compile(r"simulator: kernel compiled: ")
_RUNS = re.compile(r"simulator: .* stand ready, time runs")
_JOINED = re.compile(r"simulator: (\d+) participants have joined")
_STARTED = re.compile(r"^process\[[^\]]+-\d+\]: started with pid")
_WITHOUT = re.compile(r"simulator: time starts without all participants.*")


class Startup:
    """Reads the logs of a launch.

    Attributes:
        compiling: the simulator's words while it compiles a kernel, else empty.
        runs: the simulator has started time.
        joined: how many participants it has waited for, None while it waits.
        started: how many processes roslaunch has started, its own (rosout, in a master of its own) left out.
        incomplete: its words when it has started time without some of them, else empty.
    """

    def __init__(self, folder: Path) -> None:
        """Have read nothing yet of the logs in ``folder``."""
        self._folder = folder
        self._read: dict[str, int] = {}
        self._seen: set[str] = set()
        self.compiling = ""
        self.runs = False
        self.joined: int | None = None
        self.started = 0
        self.incomplete = ""

    def look(self) -> bool:
        """Read what is new and return whether anything moves."""
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
        for folder, _, names in os.walk(self._folder):  # follows no links: roslaunch leaves one to its newest logs
            for name in names:
                if name.endswith(".log"):
                    yield os.path.join(folder, name)

    def _lines(self, path: str) -> list[str]:
        """Return the whole lines of a file that are new."""
        begin = self._read.get(path, 0)
        try:
            with open(path, "rb") as file:
                file.seek(begin)
                data = file.read(_MOST)
        except OSError:  # it is gone again
            return []
        whole = data[: data.rfind(b"\n") + 1] or (data if len(data) == _MOST else b"")
        self._read[path] = begin + len(whole)
        return _COLOURS.sub("", whole.decode("utf-8", errors="replace")).splitlines()
