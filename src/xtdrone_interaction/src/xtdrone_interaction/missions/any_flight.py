"""A flight of no particular kind, such as that of ``./xtdrone demo hello``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.missions.mission import FlightReport, Mission
from xtdrone_interaction.recording.open_recording import open_recording
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.analyse import recording_report


class AnyFlight(Mission):
    """A flight of no particular kind: its report is the analysis of the recording."""

    name = "flight"

    def report(self, file: Path, settings: dict[str, Any]) -> FlightReport:
        """Read a recorded flight, and return its metrics, judgement, tables and figures."""
        try:
            page, data, figures = recording_report(open_recording([file]))
        except (BagError, OSError) as error:
            raise RecordError(str(error)) from error
        page.title, page.notes = "Flight", [note for note in page.notes if note not in data["collisions"]]
        return FlightReport({**data, "settings": settings, "shortcomings": data["collisions"]}, page, figures)
