"""The report of a cooperative search."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from xtdrone_interaction.missions.mission import FlightReport, Mission
from xtdrone_interaction.missions.search.figures import draw_map
from xtdrone_interaction.missions.search.metrics import make_report
from xtdrone_interaction.missions.search.prepare import Prepared, is_search, read_prepared
from xtdrone_interaction.missions.search.record import SearchRecord, read_search
from xtdrone_interaction.pictures.picture_style import NamedFigure
from xtdrone_interaction.report.html_page import ReportPage
from xtdrone_interaction.report.report_tables import ReportTable


class SearchMission(Mission):
    """A cooperative search."""

    name = "search"
    results = ("views.mp4", "find.png", "views.png", "plans/*.plan", "region.yaml", "search.world")

    def recognises(self, file: Path) -> bool:
        """Return whether the files prepared for a search are beside a recording."""
        return is_search(file.parent)

    def report(self, file: Path, settings: dict[str, Any]) -> FlightReport:
        """Read a recorded search, and return its metrics, judgement, tables and figures."""
        prepared = read_prepared(file.parent)
        record = read_search(file, prepared.names, prepared.persons)
        data = make_report(record, settings)
        page = ReportPage("Cooperative search", summarise(data), tables=[vehicles_table(data["vehicles"])])
        page.notes.append(f"./xtdrone record-view search --bag {file} films it as rviz shows it")
        return FlightReport(data, page, figures(record, prepared))


def figures(record: SearchRecord, prepared: Prepared) -> Iterator[NamedFigure]:
    """Yield the map of a search."""
    yield NamedFigure("map", "Map", draw_map(record, prepared.region, prepared.pieces, prepared.ways))


def summarise(report: dict[str, Any]) -> str:
    """Return finds and coverage as sentences."""
    covered = report["covered"]
    lines = [] if report["outcome"] == "found" else [f"{report['outcome'].capitalize()}. {report['reason']}"]
    lines += [_describe_find(find) for find in report["finds"]]
    for following in report["following"]:
        share = following["in_view"]
        part = "" if share is None else f", in view in {100 * share:.0f} % of the images"
        lines.append(f"{following['vehicle']} followed for {following['duration']:.0f} s{part}.")
    for candidate in report["possible"][:5]:
        x, y = candidate["position"][:2]
        lines.append(f"Seen but not confirmed: ({x:.1f}, {y:.1f}) m, {candidate.get('hits', 0)} images.")
    if covered["fraction"] is not None:
        area = "" if covered["area"] is None else f"{covered['area']:.0f} of {covered['region_area']:.0f} m^2, "
        wall = report["settings"].get("wall_time")
        pace = f", {report['simulated_time'] / wall:.2f} x real time including start-up" if wall else ""
        share = 100 * covered["fraction"]
        lines.append(f"Covered {area}{share:.1f} %, in {report['simulated_time']:.0f} s{pace}.")
    return "\n".join(lines)


def _describe_find(find: dict[str, Any]) -> str:
    x, y = find["position"]
    error = "" if find["error"] is None else f", {find['error']:.2f} m from {find['person']}"
    again = " again" if find["again"] else ""
    return f"Found{again} by {find['vehicle']} at {find['time']:.1f} s, at ({x:.1f}, {y:.1f}) m{error}."


def _pace(report: dict[str, Any]) -> str:
    wall = report["settings"].get("wall_time")
    return f", {report['simulated_time'] / wall:.2f} x real time including start-up" if wall else ""


def vehicles_table(vehicles: dict[str, dict[str, Any]]) -> ReportTable:
    """Return the table of the vehicles' flights and images."""
    rows = [
        (
            name,
            f"{item['distance']:.0f}",
            f"{item['greatest_height']:.1f}",
            str(item["pictures"]),
            str(item["dropped"]),
        )
        for name, item in vehicles.items()
    ]
    return ReportTable("Vehicles", ("vehicle", "path (m)", "top (m)", "images", "skipped"), rows)
