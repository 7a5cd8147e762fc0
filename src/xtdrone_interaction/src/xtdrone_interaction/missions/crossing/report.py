"""The report of a flight through obstacles."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.missions.crossing.figures import figures, save_film
from xtdrone_interaction.missions.crossing.metrics import make_report
from xtdrone_interaction.missions.demo import planning_times
from xtdrone_interaction.missions.fleet_record import read_fleet_record
from xtdrone_interaction.missions.mission import FlightReport, Mission
from xtdrone_interaction.missions.solids import solids_of_world
from xtdrone_interaction.report.html_page import ReportPage
from xtdrone_interaction.report.report_tables import ReportTable, number


class CrossingMission(Mission):
    """A flight through obstacles."""

    name = "crossing"
    settings_file = "forest.json"

    def report(self, file: Path, settings: dict[str, Any]) -> FlightReport:
        """Read a recorded flight, and return its metrics, judgement, tables and figures."""
        names = [vehicle.name for vehicle in parse_fleet(str(settings["fleet"]))]
        record = read_fleet_record(file, names)
        solids = solids_of_world(str(settings["world"]))
        data = make_report(record, solids, settings, planning_times(file.parent))
        page = ReportPage("Flight through obstacles", summarise(data), tables=[vehicles_table(data)])
        if data["timings"]:
            page.tables.append(timings_table(data["timings"]))
        return FlightReport(data, page, figures(record, solids), lambda file, _: save_film(record, solids, file))


def vehicles_table(report: dict[str, Any]) -> ReportTable:
    """Return the table of the vehicles' flights."""
    head = ("vehicle", "outcome", "straight\n(m)", "time\n(s)", "mean speed\n(m/s)", "time without\nobstacles (s)",
            "path\n(m)", "nearest obstacle\nfrom its centre (m)")  # fmt: skip
    keys = (("straight", 1), ("time", 1), ("mean_speed", 1), ("straight_time", 1), ("path", 1), ("clearance", 2))
    rows = [
        (name, item["outcome"], *(number(item.get(key), digits) for key, digits in keys))
        for name, item in report["vehicles"].items()
    ]
    return ReportTable("Vehicles", head, rows, texts=frozenset({1}))


def timings_table(timings: dict[str, Any]) -> ReportTable:
    """Return the table of the planners' computation times, wall time on this machine."""
    rows = [
        (name, words, number(found["median_ms"], 1), number(found["p95_ms"], 1), str(found["count"]))
        for name, times in timings.items()
        for kind, words in (("map", "map update"), ("plan", "plan"))
        if (found := times.get(kind)) is not None
    ]
    head = ("vehicle", "computation", "median (ms)", "95 % (ms)", "number")
    return ReportTable("Computation, wall time on this machine", head, rows, texts=frozenset({1}))


def summarise(report: dict[str, Any]) -> str:
    """Return the figures of all vehicles together, as sentences."""
    lines = [f"{report['simulated_time']:.1f} s simulated."]
    if report["least_distance"] is not None:
        lines.append(f"Minimum distance of two vehicles {report['least_distance']:.2f} m.")
    formation = report["formation"]
    if formation is not None:
        parts = []
        for key, words in (("before", "before the way"), ("during", "on it"), ("after", "formed again")):
            if formation[key] is not None:
                mean, most = formation[key]["mean"], formation[key]["most"]
                parts.append(f"{words} {mean:.2f} m on average, at most {most:.2f} m")
        if formation["formed_again_after"] is not None:
            parts.append(f"{formation['formed_again_after']:.1f} s after the leader's arrival")
        lines.append(f"Formation {formation['pattern']}, error: {'; '.join(parts)}.")
    return "\n".join(lines)
