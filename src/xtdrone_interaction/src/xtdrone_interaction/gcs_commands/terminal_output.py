"""Output of the command line: lines that are redrawn in place, and the result of each vehicle."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from xtdrone_interaction.gcs.vehicle_addresses import GcsError, Peer

_REDRAW = 0.05  # s between two updates of the progress


def redraws(file: Any) -> bool:
    """Return whether a file is a terminal that can redraw lines in place."""
    terminal = bool(getattr(file, "isatty", lambda: False)())
    return terminal and os.environ.get("TERM", "dumb") != "dumb"


class Screen:
    """Lines at the bottom of a terminal, redrawn in place and cut to its size."""

    def __init__(self, file: Any) -> None:
        """Draw nothing yet; ``file``: the terminal."""
        self._file = file
        self._drawn = 0  # lines
        self._size: os.terminal_size | None = None  # at the last drawing

    @property
    def columns(self) -> int:
        """Number of characters in a line: one less than the terminal's, because a full line may wrap."""
        return max(shutil.get_terminal_size().columns - 1, 1)

    def draw(self, lines: Sequence[str]) -> None:
        """Replace the lines on the screen."""
        size = shutil.get_terminal_size()
        room = max(size.lines - 1, 2)
        if len(lines) > room:
            lines = [*lines[: room - 1], f"... and {len(lines) - room + 1} more"]
        picture = (
            "\x1b[2J\x1b[H" if self._size not in (None, size) else self._back()
        )  # a resized terminal may have wrapped the lines
        picture += "".join(f"\x1b[2K{line[: self.columns]}\n" for line in lines)
        self._file.write(f"{picture}\x1b[J")
        self._file.flush()
        self._drawn, self._size = len(lines), size

    def erase(self) -> None:
        """Remove the lines from the screen."""
        self._file.write(f"{self._back()}\x1b[J")
        self._drawn = 0

    def _back(self) -> str:
        return f"\x1b[{self._drawn}A" if self._drawn else ""


class Display:
    """Progress of each vehicle on a terminal, and the results."""

    def __init__(self, names: Sequence[str], file: Any = None) -> None:
        """Show vehicles by ``names`` on ``file``, standard output by default."""
        self._file = file or sys.stdout
        self._lines = {name: "waiting" for name in names}
        self._width = max(map(len, names), default=0) + 2
        self._screen = Screen(self._file) if redraws(self._file) else None
        self._drawn = 0.0  # time of the last update
        self._draw()

    def watch(self, name: str, what: str, done: int, total: int) -> None:
        """Show the progress of a vehicle."""
        self._lines[name] = f"{what} {done}/{total}"
        if time.monotonic() - self._drawn >= _REDRAW:
            self._draw()

    def results(self, peers: Sequence[Peer], results: dict[str, Any], text: Callable[[str, Any], str]) -> int:
        """Print the result of each vehicle, errors to standard error, and return the exit status.

        Args:
            peers: Vehicles.
            results: Result or error by name of the vehicle; the errors of ``text`` are added.
            text: Returns the line of a vehicle from its name and its result; may raise GcsError.
        """
        if self._screen is not None:
            self._screen.erase()
        for peer in peers:
            name = peer.name
            try:
                if isinstance(results[name], GcsError):
                    raise results[name]
                self._lines[name] = text(name, results[name])
            except GcsError as error:
                results[name], self._lines[name] = error, "failed"
            print(self._line(name), file=self._file)
        self._file.flush()
        return print_errors(results.values())

    def _draw(self) -> None:
        self._drawn = time.monotonic()
        if self._screen is not None:
            self._screen.draw([self._line(name) for name in self._lines])

    def _line(self, name: str) -> str:
        return f"{name:<{self._width}}{self._lines[name]}"


def print_errors(results: Iterable[Any]) -> int:
    """Print the errors among ``results`` to standard error and return the exit status."""
    errors = [result for result in results if isinstance(result, GcsError)]
    for error in errors:
        print(f"xtdrone gcs: {error}", file=sys.stderr)
    return 1 if errors else 0
