"""What the analysis of a recording asks of a mission that the recording holds; ``missions`` has the kinds of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Protocol

from xtdrone_interaction.pictures.picture_style import NamedFigure
from xtdrone_interaction.recording.recorded_flight import Recording
from xtdrone_interaction.report.report_tables import ReportTable


class FoundMission(Protocol):
    """A formation flight, or another mission whose parts the positions of the vehicles tell."""

    @property
    def marks(self) -> list[tuple[float, str]]:
        """Beginning, s, and name of each part that was flown."""

    def parts(self) -> list[dict[str, Any]]:
        """Return the metrics of each part as plain data.

        Raises:
            RecordError: there are none.
        """

    def metrics(self) -> dict[str, Any]:
        """Return all metrics as plain data, with ``shortcomings``, sentences.

        Raises:
            RecordError: there are none.
        """

    def figures(self) -> Iterator[NamedFigure]:
        """Yield the pictures, each drawn on demand."""

    def table(self, metrics: dict[str, Any]) -> ReportTable:
        """Return the table of the metrics."""

    def summary(self, metrics: dict[str, Any]) -> str:
        """Return the metrics in a sentence."""


Finder = Callable[[Recording], FoundMission | None]
"""Finds the mission in a recording; None without."""


def find_none(_: Recording) -> None:
    """Find no mission: a recording is then analysed as any flight."""
