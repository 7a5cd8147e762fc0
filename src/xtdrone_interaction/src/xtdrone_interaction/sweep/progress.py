"""Progress of a sweep: a bar on a terminal, otherwise a line every few seconds."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any

from rich import progress as bar
from rich.console import Console
from rich.markup import escape

_LINE_EVERY = 10.0  # s, without a terminal
_SPAN = 30.0  # s over which the rate is averaged


class Progress:
    """Counts runs and shows the count, the rate, the time left and the failures."""

    def __init__(self, console: Console, total: int) -> None:
        """Show ``total`` runs on ``console``."""
        self._console = console
        self._total = total
        self._done = self._failed = self._workers = 0
        self._counts = [(time.monotonic(), 0)]
        self._said = time.monotonic()
        self._bar = bar.Progress(
            bar.TextColumn("flying"),
            bar.BarColumn(),
            bar.MofNCompleteColumn(),
            bar.TextColumn("{task.fields[text]}"),
            bar.TimeElapsedColumn(),
            console=console,
            refresh_per_second=4,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=total, text="")

    def __enter__(self) -> Progress:
        """Begin to show."""
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Show the last state and end."""
        self.show(self._workers)
        self._bar.stop()
        if not self._console.is_terminal:
            self._line()

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Count finished runs and print the error of the first failure."""
        self._done += len(rows)
        failed = [row for row in rows if row["error"] is not None]
        if failed and not self._failed:
            text = f"A run has failed (seed {failed[0]['seed']}): {one_line(failed[0]['error'])}"
            self._console.print(escape(text), highlight=False, soft_wrap=True)
        self._failed += len(failed)

    def show(self, workers: int) -> None:
        """Show the state; called several times a second."""
        now = time.monotonic()
        self._workers = workers
        if now - self._counts[-1][0] >= 1.0:
            self._counts.append((now, self._done))
        while len(self._counts) > 2 and now - self._counts[0][0] > _SPAN:
            del self._counts[0]
        self._bar.update(self._task, completed=self._done, text=self._text(now))
        if not self._console.is_terminal and now - self._said >= _LINE_EVERY:
            self._said = now
            self._line()

    def _text(self, now: float) -> str:
        if not self._workers:
            return "waiting for workers"
        began, before = self._counts[0]
        rate = (self._done - before) / max(now - began, 1e-9)
        parts = [f"{self._failed:,} failed, {self._workers} workers, {rate:.3g} runs/s"]
        if rate > 0.0 and self._done < self._total:
            parts.append(f"{_duration((self._total - self._done) / rate)} left")
        return ", ".join(parts)

    def _line(self) -> None:
        self._console.print(
            f"{self._done:,} of {self._total:,} flown, {self._text(time.monotonic())}", highlight=False, soft_wrap=True
        )


def one_line(text: str) -> str:
    """Return a text without line breaks."""
    return " ".join(text.split())


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
