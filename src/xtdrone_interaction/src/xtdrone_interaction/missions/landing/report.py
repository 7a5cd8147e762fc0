"""The report of a landing on a robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from xtdrone_interaction.missions.landing.figures import figures
from xtdrone_interaction.missions.landing.metrics import ROBOT, TYPE, make_report, read_landing
from xtdrone_interaction.missions.mission import FlightReport, Mission
from xtdrone_interaction.recording.flight_events import EVENTS_FILE, read_events
from xtdrone_interaction.report.html_page import ReportPage
from xtdrone_interaction.report.report_tables import ReportTable, number

_ROWS = (  # words, digits, key of the touchdown
    ("distance from the centre of the tags (m)", 3, "error"),
    ("velocity across, relative to the robot (m/s)", 2, "horizontal_velocity"),
    ("velocity up, relative to the robot (m/s)", 2, "vertical_velocity"),
    ("simulated time (s)", 1, "time"),
)


class LandingMission(Mission):
    """A landing on a ground robot."""

    name = "landing"

    def recognises(self, file: Path) -> bool:
        """Return whether the events beside a recording are those of a landing."""
        try:
            events = read_events(file.parent / EVENTS_FILE)
        except ValueError:
            return False
        return bool(events) and "ugv_speed" in events[0]

    def report(self, file: Path, settings: dict[str, Any]) -> FlightReport:
        """Read a recorded landing, and return its metrics, judgement, tables and figures."""
        record = read_landing(file, f"{TYPE}_0", ROBOT)
        data = make_report(record, settings)
        page = ReportPage("Landing on a robot", f"{data['simulated_time']:.1f} s simulated.")
        touch = data["touchdown"]
        if touch is not None:
            rows = [(words, number(touch[key], digits)) for words, digits, key in _ROWS]
            page.tables.append(ReportTable("Touchdown", ("quantity", "value"), rows))
        if data["landing_time"] is not None and data["in_sight"] is not None:
            page.summary += (
                f" It landed {data['landing_time']:.1f} s after the tags were found; they were in sight in "
                f"{100 * data['in_sight']:.0f} % of the images since."
            )
        return FlightReport(data, page, figures(record, data))
