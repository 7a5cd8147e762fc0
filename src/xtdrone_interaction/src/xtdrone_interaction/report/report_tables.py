"""Tables of reports, for HTML pages and the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

if TYPE_CHECKING:
    from xtdrone_interaction.recording.flight_from_ulog import FlightLog
    from xtdrone_interaction.recording.recorded_flight import Recording

_PRINTED_ROWS = 40  # on the terminal
_MOST_ROWS = 300  # of a table of texts
_MANY_ROWS = 20  # of texts; longer tables are folded
_METRICS = (  # head of the column, digits, key
    ("armed (s)", 1, "armed_time"),
    ("path (m)", 1, "way"),
    ("highest (m)", 2, "highest"),
    ("max. speed (m/s)", 2, "greatest_speed"),
    ("fastest climb (m/s)", 2, "greatest_climb"),
    ("minimum voltage (V)", 2, "least_voltage"),
)
_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
_LEVELS = {4: "warning", 8: "error", 16: "fatal"}


@dataclass(frozen=True)
class ReportTable:
    """A table of a report.

    Attributes:
        title: above it.
        head: of the columns, with units.
        rows: texts.
        long: whether it is folded on the page and left out on the terminal.
        texts: left-aligned columns by number, from 0; the first always is.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    long: bool = False
    texts: frozenset[int] = frozenset()


def print_table(table: ReportTable, console: Console) -> None:
    """Print the first rows of a table."""
    printed = Table(title=table.title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for column, name in enumerate(table.head):
        left = column == 0 or column in table.texts
        printed.add_column(name, justify="left" if left else "right", no_wrap=column == 0)
    for row in table.rows[:_PRINTED_ROWS]:
        printed.add_row(*(escape(cell) for cell in row))
    console.print(printed)


def number(value: float | None, digits: int = 2) -> str:
    """Return a number as text; empty if it is unknown."""
    return "" if value is None else f"{value:.{digits}f}"


def odometry_table(rows: Iterable[dict[str, Any]]) -> ReportTable:
    """Return the table of odometry against the truth.

    Args:
        rows: Metrics of each, see :class:`~xtdrone_interaction.metrics.odometry_errors.OdometryErrors`.
    """
    head = ("odometry", "aligned", "path (m)", "ATE (m)", "max (m)", "end (m)", "drift (%)", "RPE (%)")
    keys = (("way", 1), ("ate", 3), ("greatest", 3), ("end", 3), ("drift", 3), ("rpe_percent", 2))
    texts = [
        (f"{row['vehicle']} {row['source']}", row["alignment"], *(number(row[key], digits) for key, digits in keys))
        for row in rows
    ]
    return ReportTable("Odometry against the truth", head, texts, texts=frozenset({1}))


def map_table(rows: Iterable[dict[str, Any]]) -> ReportTable:
    """Return the table of maps against the true surfaces.

    Args:
        rows: metrics of each map, see ``missions.true_surfaces``.
    """
    head = ("map", "points", "error (m)", "gap (m)", "chamfer (m)", "precision (%)", "recall (%)", "F (%)")
    keys = ("error", "gap", "chamfer"), ("precision", "recall", "f_score")
    texts = [
        (
            row["map"],
            str(row["points"]),
            *(number(row[key], 3) for key in keys[0]),
            *(number(None if row[key] is None else 100.0 * row[key], 1) for key in keys[1]),
        )
        for row in rows
    ]
    return ReportTable("Maps against the true surfaces, at 0.1 m", head, texts)


def vehicles_table(vehicles: dict[str, dict[str, Any]]) -> ReportTable:
    """Return the table of the vehicles' metrics, without columns that are unknown of all of them."""
    columns = [
        (head, digits, key) for head, digits, key in _METRICS if any(v[key] is not None for v in vehicles.values())
    ]
    rows = [
        (name, *(number(item[key], digits) for _, digits, key in columns), str(item["warnings"]))
        for name, item in vehicles.items()
    ]
    head = ("vehicle", *(head for head, _, _ in columns), "warnings")
    return ReportTable("Vehicles", head, rows, long=len(rows) > 60)


def modes_table(vehicles: dict[str, dict[str, Any]]) -> ReportTable:
    """Return the table of the time each vehicle spent in each mode."""
    rows = [
        (name, ", ".join(f"{mode} {seconds:.1f}" for mode, seconds in item["modes"].items()))
        for name, item in vehicles.items()
    ]
    return ReportTable("Seconds in each mode", ("vehicle", "modes (s)"), rows, long=True, texts=frozenset({1}))


def texts_table(recording: Recording) -> ReportTable:
    """Return the table of the autopilots' status texts."""
    rows = sorted((at, vehicle.name, bad, text) for vehicle in recording.vehicles for at, bad, text in vehicle.texts)
    cells = [(f"{at:.2f}", name, _severity(bad), text) for at, name, bad, text in rows]
    return _shortened("Texts of the autopilots", ("time (s)", "vehicle", "severity", "text"), cells)


def _severity(level: int) -> str:
    return _SEVERITIES[level] if 0 <= level < len(_SEVERITIES) else str(level)


def warnings_table(recording: Recording) -> ReportTable:
    """Return the table of the nodes' warnings and errors."""
    cells = [(f"{at:.2f}", node, _LEVELS.get(level, str(level)), text) for at, level, node, text in recording.log]
    return _shortened("Warnings of nodes", ("time (s)", "node", "level", "text"), cells)


def _shortened(title: str, head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> ReportTable:
    if len(rows) > _MOST_ROWS:
        title = f"{title} (the first {_MOST_ROWS} of {len(rows)})"
    folded = len(rows) > _MANY_ROWS
    return ReportTable(title, head, rows[:_MOST_ROWS], long=folded, texts=frozenset(range(1, len(head))))


def topics_table(recording: Recording) -> ReportTable:
    """Return the table of recorded topics."""
    rows = [
        (
            topic.name,
            topic.type,
            str(topic.count),
            "" if math.isnan(topic.rate) else f"{topic.rate:.1f}",
            f"{topic.bytes / 1e6:.3f}",
            str(topic.publishers),
        )
        for topic in recording.topics
    ]
    head = ("topic", "type", "messages", "rate (Hz)", "MB", "publishers")
    return ReportTable(f"Topics ({len(rows)})", head, rows, long=True, texts=frozenset({1}))


def log_tables(log: FlightLog, metrics: dict[str, Any]) -> list[ReportTable]:
    """Return all tables of a flight log."""
    responses = [
        (
            f"{item['what'].lower()}, {item['name']}",
            f"{item['rms']:.3f}",
            f"{item['greatest']:.3f}",
            "" if item["delay"] is None else f"{1e3 * item['delay']:.0f}",
        )
        for item in metrics["tracking"]
    ]
    modes = [(mode, f"{seconds:.1f}") for mode, seconds in metrics["modes"].items()]
    texts = [(f"{time:.2f}", severity, text) for time, severity, text in log.texts]
    changed = [(name, f"{value:g}", "" if usual is None else f"{usual:g}") for name, value, usual in log.changed]
    topics = [(name, str(instance), str(count)) for (name, instance), count in sorted(log.counts.items())]
    tables = [
        ReportTable(
            f"Setpoint and response {log.flown_words}",
            ("quantity", "error, RMS", "greatest", "delay (ms)"),
            responses,
        ),
        ReportTable("Seconds in each mode", ("mode", "time (s)"), modes),
        _shortened("Texts", ("time (s)", "severity", "text"), texts),
        ReportTable(f"Changed parameters ({len(changed)})", ("name", "value", "default"), changed, long=True),
        ReportTable(f"Topics ({len(topics)})", ("topic", "instance", "messages"), topics, long=True),
    ]
    return tables[:2] + [table for table in tables[2:] if table.rows]
