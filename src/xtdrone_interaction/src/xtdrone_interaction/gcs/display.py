"""What the command line shows: lines that are redrawn in place, and how it ends with each vehicle."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from .peers import GcsError, Peer

_REDRAW = 0.05  # s between two pictures of progress


def redraws(file: Any) -> bool:
    """Return whether a file is a terminal that can redraw lines in place."""
    terminal = bool(getattr(file, "isatty", lambda: False)())
    return terminal and os.environ.get("TERM", "dumb") != "dumb"


class Screen:
    """Lines at the foot of a terminal, redrawn in place; as many and as much of them as it has room for."""

    def __init__(self, file: Any) -> None:
        """Draw nothing yet; ``file``: the terminal."""
        self._file = file
        self._drawn = 0  # lines
        self._size: os.terminal_size | None = None  # at the last drawing

    @property
    def columns(self) -> int:
        """Letters that a line may have; one less than the terminal's, since a full line may wrap."""
        return max(shutil.get_terminal_size().columns - 1, 1)

    def draw(self, lines: Sequence[str]) -> None:
        """Show these lines in place of those before."""
        size = shutil.get_terminal_size()
        room = max(size.lines - 1, 2)
        if len(lines) > room:
            lines = [*lines[: room - 1], f"... and {len(lines) - room + 1} more"]
        picture = "\x1b[2J\x1b[H" if self._size not in (None, size) else self._back()  # a terminal may wrap lines anew
        picture += "".join(f"\x1b[2K{line[: self.columns]}\n" for line in lines)
        self._file.write(f"{picture}\x1b[J")
        self._file.flush()
        self._drawn, self._size = len(lines), size

    def erase(self) -> None:
        """Show none of them any more."""
        self._file.write(f"{self._back()}\x1b[J")
        self._drawn = 0

    def _back(self) -> str:
        return f"\x1b[{self._drawn}A" if self._drawn else ""


class Display:
    """What is under way with each vehicle, on a terminal, and how it has ended."""

    def __init__(self, names: Sequence[str], file: Any = None) -> None:
        """Show ``names`` on ``file``, standard output unless given."""
        self._file = file or sys.stdout
        self._lines = {name: "waiting" for name in names}
        self._width = max(map(len, names), default=0) + 2
        self._screen = Screen(self._file) if redraws(self._file) else None
        self._drawn = 0.0  # when
        self._draw()

    def watch(self, name: str, what: str, done: int, total: int) -> None:
        """Take a vehicle's progress."""
        self._lines[name] = f"{what} {done}/{total}"
        if time.monotonic() - self._drawn >= _REDRAW:
            self._draw()

    def results(self, peers: Sequence[Peer], results: dict[str, Any], text: Callable[[str, Any], str]) -> int:
        """Show how it ended with each vehicle, errors on standard error; return the exit status.

        Args:
            peers: the vehicles.
            results: by name what came of it, or the error.
            text: returns the last line of a vehicle (its name) where it went well, given what came of it.
        """
        if self._screen is not None:
            self._screen.erase()
        for peer in peers:
            result = results[peer.name]
            self._lines[peer.name] = "failed" if isinstance(result, GcsError) else text(peer.name, result)
            print(self._line(peer.name), file=self._file)
        self._file.flush()
        return tell_errors(results.values())

    def _draw(self) -> None:
        self._drawn = time.monotonic()
        if self._screen is not None:
            self._screen.draw([self._line(name) for name in self._lines])

    def _line(self, name: str) -> str:
        return f"{name:<{self._width}}{self._lines[name]}"


def tell_errors(results: Iterable[Any]) -> int:
    """Write those of ``results`` that are errors on standard error; return the exit status."""
    errors = [result for result in results if isinstance(result, GcsError)]
    for error in errors:
        print(f"xtdrone gcs: {error}", file=sys.stderr)
    return 1 if errors else 0
