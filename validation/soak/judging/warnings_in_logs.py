"""Warnings by kind, and tracebacks, in the text logs of a soak; the files are read while they grow."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

TRACEBACK = "Traceback (most recent call last)"
# the master's collected log: "1.5 WARN /simulator [node.py:12(f)] [topics: /rosout, /clock] text"
_ROSOUT = re.compile(
    r"^[\d.]+ (?P<level>WARN|ERROR|FATAL) (?P<node>/\S+) \[[^\]]*\] (?:\[topics:[^\]]*\] )?(?P<text>.*)"
)
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_NUMBERS = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
_OWN_NAME = re.compile(r"soak_\d+_([a-z]+)_\d+")
_LOST = re.compile(r"\b(lost|dropped|not come|has not arrived|missing)\b", re.IGNORECASE)
_ROSOUT_CLOSED = "rospy.exceptions.ROSException: publish() to a closed topic"
_LONGEST = 160  # characters of the name of a kind
_MOST_KINDS = 500
_QUOTED = 30  # lines of a traceback


def kind_of(level: str, node: str, text: str) -> str:
    """Return the kind of a warning: its text without the varying parts."""
    words = _OWN_NAME.sub(r"soak_\1", f"{level} {node}: {text}")
    return _NUMBERS.sub("#", words)[:_LONGEST]


class TextLogs:
    """The logs of the processes that run for the whole soak.

    Attributes:
        warnings: number of warnings by kind.
        lost: number of those about lost messages or dropped participants.
        tracebacks: first lines and file of each; without those of the master, whose log has one for each killed node.
    """

    def __init__(self, folder: Path) -> None:
        """Read ``folder`` and its sub-folders, except those of single nodes."""
        self.warnings: Counter[str] = Counter()
        self.lost = 0
        self.tracebacks: list[str] = []
        self._folder = folder
        self._read: dict[Path, int] = {}

    def update(self) -> None:
        """Read the new lines."""
        for path in sorted(self._folder.glob("*.log")) + sorted(self._folder.glob("*/*.log")):
            if path.parent.name != "nodes" and not path.parent.is_symlink():
                self._look_at(path)

    def _look_at(self, path: Path) -> None:
        at = self._read.get(path, 0)
        size = path.stat().st_size
        if size < at:  # restarted
            at = 0
        if size == at:
            return
        with path.open("rb") as file:
            file.seek(at)
            data = file.read(size - at)
        whole = data[: data.rfind(b"\n") + 1]
        self._read[path] = at + len(whole)
        lines = _COLOURS.sub("", whole.decode("utf-8", errors="replace")).splitlines()
        collected = path.name.startswith("rosout") and "stdout" not in path.name
        # The collected log repeats the logs of all nodes, also of killed ones; the master logs a traceback for each
        # update that it cannot deliver to a killed node.
        if not collected and not path.name.startswith("master"):
            self.tracebacks += tracebacks(path, lines)
        for line in lines if collected else ():
            if match := _ROSOUT.match(line):
                self._count(match)

    def _count(self, match: re.Match[str]) -> None:
        kind = kind_of(match["level"], match["node"], match["text"])
        if kind in self.warnings or len(self.warnings) < _MOST_KINDS:
            self.warnings[kind] += 1
        else:
            self.warnings["(further kinds)"] += 1
        self.lost += bool(_LOST.search(match["text"]))


def tracebacks(path: Path, lines: list[str]) -> list[str]:
    """Return the tracebacks among the lines of a file, each limited to its first lines.

    Those of rospy's own logging are excluded: a node that logs during its shutdown finds /rosout closed.
    """
    places = [number for number, line in enumerate(lines) if TRACEBACK in line]
    found = ["\n".join(lines[place : place + _QUOTED]) for place in places]
    return [f"{path}:\n{text}" for text in found if _ROSOUT_CLOSED not in text]


def tracebacks_in(folder: Path) -> list[str]:
    """Return the tracebacks in all logs of a folder."""
    found = []
    for path in sorted(folder.rglob("*.log")):
        if not path.is_symlink():
            found += tracebacks(path, path.read_text(encoding="utf-8", errors="replace").splitlines())
    return found
