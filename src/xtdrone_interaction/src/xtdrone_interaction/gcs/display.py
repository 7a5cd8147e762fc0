"""What the command line shows: a line for each vehicle."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from .peers import GcsError, Peer

_REDRAW = 0.05  # s between two pictures while it goes on


class Display:
    """A line for each vehicle: redrawn on a terminal, else one when it is done."""

    def __init__(self, names: Sequence[str], file: Any = None) -> None:
        """Show ``names`` on ``file``, standard output unless given."""
        self._file = file or sys.stdout
        self._lines = {name: "waiting" for name in names}
        self._live = bool(getattr(self._file, "isatty", lambda: False)())
        self._width = max(map(len, names), default=0) + 2
        self._drawn = -math.inf  # when

    def watch(self, name: str, what: str, done: int, total: int) -> None:
        """Take a vehicle's progress."""
        self._set(name, f"{what} {done}/{total}", final=False)

    def end(self, name: str, text: str) -> None:
        """Take a vehicle's last line."""
        self._set(name, text, final=True)

    def _set(self, name: str, text: str, final: bool) -> None:
        self._lines[name] = text
        if self._live:
            if final or time.monotonic() - self._drawn >= _REDRAW:
                self._draw()
        elif final:
            print(f"{name:<{self._width}}{text}", file=self._file, flush=True)

    def _draw(self) -> None:
        if math.isfinite(self._drawn):
            print(f"\x1b[{len(self._lines)}A", end="", file=self._file)
        self._drawn = time.monotonic()
        for name, text in self._lines.items():
            print(f"\x1b[2K{name:<{self._width}}{text}", file=self._file)
        self._file.flush()

    def results(self, peers: Sequence[Peer], results: dict[str, Any], text: Callable[[str, Any], str]) -> int:
        """Show how it ended with each vehicle, errors on standard error; return the exit status.

        Args:
            peers: the vehicles.
            results: by name what came of it, or the error.
            text: returns the last line of a vehicle (its name) where it went well, given what came of it.
        """
        for peer in peers:
            result = results[peer.name]
            self.end(peer.name, "failed" if isinstance(result, GcsError) else text(peer.name, result))
        return tell_errors(results.values())


def tell_errors(results: Iterable[Any]) -> int:
    """Write those of ``results`` that are errors on standard error; return the exit status."""
    errors = [result for result in results if isinstance(result, GcsError)]
    for error in errors:
        print(f"xtdrone gcs: {error}", file=sys.stderr)
    return 1 if errors else 0
