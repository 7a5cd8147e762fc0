"""Report and pictures of any recording."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_interaction.metrics.odometry_errors import write_trajectories
from xtdrone_interaction.metrics.vehicle_metrics import summarise, summarise_log
from xtdrone_interaction.pictures import recording_pictures, ulog_pictures
from xtdrone_interaction.pictures.picture_style import NamedFigure
from xtdrone_interaction.recording.flight_from_ulog import FlightLog
from xtdrone_interaction.recording.found_mission import Finder, find_none
from xtdrone_interaction.recording.open_recording import open_recording
from xtdrone_interaction.recording.recorded_flight import Recording
from xtdrone_interaction.report import report_tables
from xtdrone_interaction.report.html_page import ReportPage, print_page, write_page


def analyse(
    files: Sequence[Path],
    folder: Path,
    console: Console,
    part: int | None = None,
    find: Finder = find_none,
    maps: Sequence[dict[str, Any]] = (),
) -> None:
    """Write the report of a recording, and print it.

    Args:
        files: One file, or the consecutive bags of a split recording.
        folder: Existing folder of the report.
        console: Console that shows it.
        part: Number of the flight in a bag whose simulated time was reset, from 1; None for the longest.
        find: Finds the mission in the recording.
        maps: Rows of the table of maps, see ``report_tables.map_table``.

    Raises:
        BagError, LogError, RecordError: nothing can be read of it.
    """
    recording = open_recording(files, part)
    if recording.flight_log is not None:
        log = recording.flight_log
        metrics = summarise_log(recording, log)
        page, figures = _log_page(log, metrics), ulog_pictures.pictures(log)
    else:
        page, metrics, figures = recording_report(recording, find, maps)
        write_trajectories(recording, folder)
    print_page(page, console)
    write_page(page, metrics, figures, folder, console)


def recording_report(
    recording: Recording, find: Finder = find_none, maps: Sequence[dict[str, Any]] = ()
) -> tuple[ReportPage, dict[str, Any], Iterator[NamedFigure]]:
    """Return page, metrics and pictures of a recording that is no flight log; see :func:`analyse`."""
    found = find(recording)
    metrics = summarise(recording, found)
    metrics["maps"] = list(maps)
    flown = metrics["formation"]
    found = found if flown else None
    page = ReportPage(f"Flight in {recording.path.name}", _summary(recording, metrics), list(metrics["notes"]))
    if found is not None:
        page.summary += f" {found.summary(flown)}"
        page.tables.append(found.table(flown))
        page.notes += flown["shortcomings"]
    else:
        page.notes += recording.collisions
    if metrics["odometry"]:
        page.tables.append(report_tables.odometry_table(metrics["odometry"]))
    if metrics["maps"]:
        page.tables.append(report_tables.map_table(metrics["maps"]))
    page.tables += [report_tables.vehicles_table(metrics["vehicles"]), report_tables.modes_table(metrics["vehicles"])]
    texts = report_tables.texts_table(recording), report_tables.warnings_table(recording)
    page.tables += [table for table in texts if table.rows]
    page.tables.append(report_tables.topics_table(recording))
    return page, metrics, recording_pictures.pictures(recording, found)


def _summary(recording: Recording, metrics: dict[str, Any]) -> str:
    vehicles = f"{len(recording.vehicles)} vehicles" if len(recording.vehicles) != 1 else "1 vehicle"
    text = f"{vehicles}, {len(recording.topics)} topics, {metrics['messages']} messages in {recording.duration:.1f} s"
    text += f", {recording.size / 1e6:.1f} MB."
    if recording.origin:
        text += f" It began at {time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(recording.origin))} UTC."
    return text


def _log_page(log: FlightLog, metrics: dict[str, Any]) -> ReportPage:
    armed = metrics["armed_time"]
    text = f"{log.duration:.1f} s, armed for {armed:.1f} s, {log.size / 1e6:.1f} MB, {len(log.counts)} topics."
    if metrics["way"] is not None and armed > 0:
        text += f" It flew {metrics['way']:.1f} m, {metrics['highest']:.1f} m above where it began"
        text += "." if metrics["greatest_speed"] is None else f", at up to {metrics['greatest_speed']:.1f} m/s."
    text += _logged_by(metrics["vehicle"])
    return ReportPage(f"Flight log {log.path.name}", text, list(log.notes), report_tables.log_tables(log, metrics))


def _logged_by(vehicle: dict[str, Any]) -> str:
    """Return the sentence on the logging software and hardware; empty if they are unknown."""
    words = " ".join(str(vehicle[key]) for key in ("sys_name", "release") if key in vehicle)
    if "ver_hw" in vehicle:
        words += f" on {vehicle['ver_hw']}"
    if "ver_sw" in vehicle:
        words += f" (git {str(vehicle['ver_sw'])[:10]})"
    return f" Logged by {words.strip()}." if words else ""
