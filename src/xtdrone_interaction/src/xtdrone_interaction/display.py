"""The progress of a flight on the terminal: a live line where there is a terminal, else a line every few seconds."""

from __future__ import annotations

import time
from typing import Any, Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

_LINE_PERIOD = 5.0  # s of wall time between two lines where there is no terminal


class Display(Protocol):
    """What the flight's progress is shown on."""

    def note(self, text: str) -> None:
        """Show a line that stays."""

    def update(self, progress: dict[str, Any]) -> None:
        """Show a message of /xtdrone/demo/progress."""

    def close(self) -> None:
        """End the display."""


def figures(progress: dict[str, Any]) -> str:
    """Return the figures of a progress message as text: simulated time, real-time factor, error, distance."""
    parts = [f"sim {progress['sim_time']:6.1f} s", f"{progress['rtf']:4.1f} x real time"]
    if progress["error"] is not None:
        parts.append(f"formation error {progress['error']:5.2f} m")
    if progress["least_distance"] is not None:
        parts.append(f"least distance {progress['least_distance']:4.2f} m")
    return "  ".join(parts)


class LiveDisplay:
    """A line that changes in place, below the notes."""

    def __init__(self, console: Console) -> None:
        """Show that the stack starts."""
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description:<18}"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("{task.fields[figures]}"),
            console=console,
            refresh_per_second=5,
        )
        self._task = self._progress.add_task("starting the nodes", total=None, figures="")
        self._progress.start()

    def note(self, text: str) -> None:
        """Show a line that stays."""
        self._progress.console.print(text, highlight=False)

    def update(self, progress: dict[str, Any]) -> None:
        """Show a message of /xtdrone/demo/progress."""
        self._progress.update(
            self._task,
            description=progress["phase"],
            completed=max(0, progress["step"] - 1),
            total=progress["steps"],
            figures=figures(progress),
        )

    def close(self) -> None:
        """Leave the last line as it is."""
        self._progress.stop()


class LineDisplay:
    """A line of progress every few seconds and at each phase."""

    def __init__(self, console: Console) -> None:
        """Show that the stack starts."""
        self._console = console
        self._shown = 0.0
        self._phase = ""
        self.note("starting the nodes")

    def note(self, text: str) -> None:
        """Show a line."""
        self._console.print(text, highlight=False, soft_wrap=True)

    def update(self, progress: dict[str, Any]) -> None:
        """Show a message of /xtdrone/demo/progress when it is time for one."""
        now = time.monotonic()
        if progress["phase"] == self._phase and now - self._shown < _LINE_PERIOD:
            return
        self._shown, self._phase = now, progress["phase"]
        self.note(f"{progress['step']:2d}/{progress['steps']} {progress['phase']:<18} {figures(progress)}")

    def close(self) -> None:
        """Nothing is left open."""
