"""The report of a formation flight, and what the analysis of any recording says of one in it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.missions.formation.figures import figures, make_film
from xtdrone_interaction.missions.formation.metrics import make_report, measure
from xtdrone_interaction.missions.formation.record import FormationRecord, formation_of, read_formation
from xtdrone_interaction.missions.mission import FlightReport, Mission
from xtdrone_interaction.pictures.picture_style import NamedFigure
from xtdrone_interaction.recording.flight_events import EVENTS_FILE
from xtdrone_interaction.recording.flight_from_bag import read_bag
from xtdrone_interaction.recording.recorded_flight import Recording
from xtdrone_interaction.recording.topics import EVENTS_TOPIC, PATTERN_TOPIC, SEARCH_EVENTS_TOPIC
from xtdrone_interaction.report.html_page import ReportPage
from xtdrone_interaction.report.report_tables import ReportTable

_FOUND = ("outcome", "positions", "reconfigurations", "least_distance", "least_distance_time", "too_close",
          "shortcomings")  # fmt: skip
_TOPICS = {EVENTS_TOPIC, PATTERN_TOPIC, SEARCH_EVENTS_TOPIC}


class FormationMission(Mission):
    """A formation flight, on ROS or in one process."""

    name = "formation"
    kept = ("startup_time", "comparison")
    results = ("comparison_*.png",)

    def recognises(self, file: Path) -> bool:
        """Return whether a recording has a director's events, or cannot be read: reading it then tells why."""
        if file.suffix != ".bag" or super().recognises(file) or (file.parent / EVENTS_FILE).is_file():
            return True
        try:
            topics = read_bag([file], wanted=lambda name: False).topics
        except (BagError, OSError):
            return True
        return bool(_TOPICS & {topic.name for topic in topics}) or not topics

    def report(self, file: Path, settings: dict[str, Any]) -> FlightReport:
        """Read a recorded flight, and return its metrics, judgement, tables and figures."""
        return report_of(read_formation(file), settings)


def report_of(record: FormationRecord, settings: dict[str, Any]) -> FlightReport:
    """Return the report of a formation flight."""
    data = make_report(record, settings)
    title = f"Formation flight of {len(record.names)} vehicles"
    page = ReportPage(title, summarise(data), tables=[formation_table(data["reconfigurations"])])
    return FlightReport(data, page, figures(record), lambda file, console: make_film(record, file, console))


def summarise(report: dict[str, Any]) -> str:
    """Return the figures of the whole flight as sentences."""
    simplified = report["settings"].get("simulator") == "simplified"
    collisions = "" if simplified else f", {len(report['collisions'])} collisions"
    line = f"Minimum distance {report['least_distance']:.2f} m{collisions}; {report['sim_time']:.1f} s simulated"
    if report["real_time_factor"] is not None:
        line += f" in {report['wall_time']:.1f} s ({report['real_time_factor']:.1f} x real time)"
    if report["startup_time"] is not None:
        line += f"; first vehicle armed {report['startup_time']:.1f} s after the command"
    lines = [f"{line}.", f"Positions: {report['positions']}."]
    if simplified:
        lines.append("Simplified vehicles do not collide: where two meet, they fly through each other.")
    return "\n".join(lines)


def formation_table(reconfigurations: Iterable[dict[str, Any]], title: str = "Formation") -> ReportTable:
    """Return the table of a formation flight.

    Args:
        reconfigurations: Metrics of each, as in the report, see ``Reconfiguration``.
        title: Title above it.
    """
    rows = [
        (
            item["pattern"],
            "never" if item["settling_time"] is None else f"{item['settling_time']:.2f}",
            f"{item['overshoot']:.2f} ({item['overshoot_percent']:.0f}%)",
            f"{item['steady_error_mean']:.3f}/{item['steady_error_max']:.3f}",
            f"{item['least_distance']:.2f}",
            f"{item['assigned_distance']:.2f}",
            f"{item['optimal_distance']:.2f}",
        )
        for item in reconfigurations
    ]
    # Line breaks make it fit into 80 columns.
    head = ("pattern", "settled\nafter (s)", "overshoot\n(m)", "steady (m)\nmean/max", "least\ngap (m)",
            "assigned\n(m)", "optimum\n(m)")  # fmt: skip
    return ReportTable(title, head, rows)


@dataclass(frozen=True)
class FoundFormation:
    """The formation flight in a recording, see ``FoundMission``."""

    record: FormationRecord

    @property
    def marks(self) -> list[tuple[float, str]]:
        """Time, s, and name of each pattern."""
        return [(window.start, window.pattern) for window in self.record.windows]

    def parts(self) -> list[dict[str, Any]]:
        """Return the metrics of each reconfiguration."""
        return [asdict(item) for item in measure(self.record, self.record.track)]

    def metrics(self) -> dict[str, Any]:
        """Return all metrics."""
        report = make_report(self.record)
        return {key: report[key] for key in _FOUND}

    def figures(self) -> Iterator[NamedFigure]:
        """Yield the pictures."""
        return figures(self.record)

    def table(self, metrics: dict[str, Any]) -> ReportTable:
        """Return the table of the metrics."""
        return formation_table(metrics["reconfigurations"])

    def summary(self, metrics: dict[str, Any]) -> str:
        """Return the metrics in a sentence."""
        return (
            f"The formation flight ended with {metrics['outcome']!r}; judged by {metrics['positions']}, the minimum "
            f"distance was {metrics['least_distance']:.2f} m."
        )


def find_formation(recording: Recording) -> FoundFormation | None:
    """Return the formation flight in a recording; None if there is none."""
    record = formation_of(recording)
    return None if record is None else FoundFormation(record)
