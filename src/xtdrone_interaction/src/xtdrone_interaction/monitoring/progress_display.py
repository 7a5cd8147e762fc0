"""The progress of a flight: a live display on a terminal, else a line every few seconds."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable
from typing import Any, Protocol

from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

_SPAN = 1.0  # s of wall time over which the real-time factor is averaged
_REMINDER = 30.0  # s of wall time between two lines while simulated time stands still
_FIGURES = re.compile(r" \(|: ")  # begins the varying part of a standstill's text: "waiting for /x (4 s)"
_LINE_PERIOD = 5.0  # s of wall time between two lines without a terminal


class Display(Protocol):
    """A display of the flight's progress."""

    def note(self, text: str) -> None:
        """Print a permanent line."""

    def update(self, progress: dict[str, Any]) -> None:
        """Show a message of /xtdrone/demo/progress."""

    def standstill(self, text: str) -> None:
        """Show why simulated time stands still; empty while it advances."""

    def close(self) -> None:
        """End the display."""


class RealTimeFactor:
    """The real-time factor over about the last second of wall time."""

    def __init__(self, span: float = _SPAN) -> None:
        """Start without samples; ``span`` is the averaging time, s of wall time."""
        self._span = span
        self._factor = 0.0
        self._since: tuple[float, float] | None = None

    def update(self, sim_time: float, wall: float) -> float:
        """Return the factor, given simulated and wall time in s; 0 until a span has passed."""
        if self._since is None:
            self._since = (sim_time, wall)
        elif wall - self._since[1] >= self._span:
            self._factor = (sim_time - self._since[0]) / (wall - self._since[1])
            self._since = (sim_time, wall)
        return self._factor


def figures(progress: dict[str, Any], factor: float) -> str:
    """Return the figures of a progress message as text.

    Args:
        progress: ``sim_time`` (s), and optionally ``error`` (m), ``least_distance`` (m), ``text``.
        factor: real-time factor.
    """
    parts = [f"sim {progress['sim_time']:6.1f} s", f"{factor:4.1f} x real time"]
    if progress.get("error") is not None:
        parts.append(f"error {progress['error']:5.2f} m")
    if progress.get("least_distance") is not None:
        parts.append(f"minimum gap {progress['least_distance']:4.2f} m")
    if progress.get("text"):
        parts.append(str(progress["text"]))
    return "  ".join(parts)


class _TwoLines(Progress):
    """A bar with the task's figures on a second line, so that both fit 80 columns."""

    def get_renderables(self) -> Iterable[RenderableType]:
        """Yield the bar, then the figures."""
        yield from super().get_renderables()
        for task in self.tasks:
            yield Text(f"  {task.fields['figures']}", no_wrap=True, overflow="ellipsis")


class LiveDisplay:
    """Two lines updated in place, below the permanent lines."""

    def __init__(self, console: Console, begin: str = "starting the nodes") -> None:
        """Show that the flight begins, in the words of ``begin``."""
        self._progress = _TwoLines(
            SpinnerColumn(),
            TextColumn("{task.description:<18}"),
            BarColumn(bar_width=20),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            refresh_per_second=5,
        )
        self._factor = RealTimeFactor()
        self._figures = ""
        self._standstill = ""
        self._task = self._progress.add_task(begin, total=None, figures="")
        self._progress.start()

    def note(self, text: str) -> None:
        """Show a line that stays."""
        self._progress.console.print(text, highlight=False, soft_wrap=True)

    def update(self, progress: dict[str, Any]) -> None:
        """Show a message of /xtdrone/demo/progress."""
        self._figures = figures(progress, self._factor.update(progress["sim_time"], time.monotonic()))
        self._progress.update(
            self._task,
            description=progress["phase"],
            completed=max(0, progress["step"] - 1),
            total=progress["steps"],
            figures=self._standstill or self._figures,
        )

    def standstill(self, text: str) -> None:
        """Show ``text`` instead of the figures; the figures if it is empty."""
        self._standstill = text
        self._progress.update(self._task, figures=text or self._figures)

    def close(self) -> None:
        """Stop updating; the last lines remain."""
        self._progress.stop()


class LineDisplay:
    """A line of progress every few seconds and at each phase."""

    def __init__(self, console: Console, begin: str = "starting the nodes") -> None:
        """Show that the flight begins, in the words of ``begin``."""
        self._console = console
        self._shown = 0.0
        self._phase = ""
        self._standstill = ""
        self._reminded = 0.0
        self._factor = RealTimeFactor()
        self.note(begin)

    def note(self, text: str) -> None:
        """Show a line."""
        self._console.print(text, highlight=False, soft_wrap=True)

    def update(self, progress: dict[str, Any]) -> None:
        """Print a message of /xtdrone/demo/progress if a line is due."""
        now = time.monotonic()
        factor = self._factor.update(progress["sim_time"], now)
        if progress["phase"] == self._phase and now - self._shown < _LINE_PERIOD:
            return
        self._shown, self._phase = now, progress["phase"]
        self.note(f"{progress['step']:2d}/{progress['steps']} {progress['phase']:<18} {figures(progress, factor)}")

    def standstill(self, text: str) -> None:
        """Print a line when the cause of a standstill changes or time resumes, and a reminder now and then."""
        now, cause = time.monotonic(), _FIGURES.split(text)[0]
        if cause == self._standstill and (not text or now - self._reminded < _REMINDER):
            return
        self.note(f"  {text or 'continues'}")
        self._standstill, self._reminded = cause, now

    def close(self) -> None:
        """Do nothing; every line is complete."""
