"""Figures of the flight in a recording, as plain data and as the tables of its report."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from xtdrone_interaction.analysis.columns import Series
from xtdrone_interaction.analysis.drawing import spans
from xtdrone_interaction.analysis.flight import Flight, Vehicle
from xtdrone_interaction.analysis.page import Page, Table
from xtdrone_interaction.record import FlightRecord, RecordError
from xtdrone_interaction.report import make_report

_MOST_ROWS = 300  # of a table of texts
_SEVERITIES = ("emergency", "alert", "critical", "error", "warning", "notice", "info", "debug")
_LEVELS = {4: "warning", 8: "error", 16: "fatal"}


def summarise(flight: Flight, record: FlightRecord | None) -> dict[str, Any]:
    """Return the figures of a recording as plain data, ready for JSON.

    Args:
        flight: what the recording says.
        record: its formation flight, if it is one.
    """
    figures: dict[str, Any] = {
        "file": str(flight.path),
        "bytes": flight.size,
        "messages": sum(topic.count for topic in flight.topics),
        "duration": flight.duration,
        "start": flight.origin or None,
        "cut_off": flight.cut,
        "notes": flight.notes,
        "vehicles": {vehicle.name: vehicle_figures(vehicle) for vehicle in flight.vehicles},
        "collisions": flight.collisions,
        "formation": None,
    }
    if record is not None:
        try:
            report = make_report(record)
            kept = ("outcome", "positions", "reconfigurations", "least_distance", "least_distance_time", "too_close",
                    "shortcomings")  # fmt: skip
            figures["formation"] = {key: report[key] for key in kept}
        except RecordError as error:
            figures["notes"] = [*flight.notes, str(error)]
    return figures


def vehicle_figures(vehicle: Vehicle) -> dict[str, Any]:
    """Return one vehicle's figures; those that are not known are None.

    Returns:
        armed_time (s), way (m), highest and lowest (m, above where it began), greatest_speed (horizontal) and
        greatest_climb (m/s), least_voltage (V), modes (s in each), warnings (how many texts of severity warning or
        worse).
    """
    place, velocity, battery = vehicle.position, vehicle.series.get("velocity"), vehicle.series.get("battery")
    found: dict[str, Any] = dict.fromkeys(
        ("armed_time", "way", "highest", "lowest", "greatest_speed", "greatest_climb", "least_voltage")
    )
    end = max((float(series.time[-1]) for series in vehicle.series.values() if len(series)), default=0.0)
    if vehicle.armed:
        found["armed_time"] = sum(stop - start for start, stop, armed in spans(vehicle.armed, end) if armed)
    if place is not None and len(place):
        found["way"] = way_length(place)
        height = place.value[:, 2] - place.value[0, 2]
        found |= {"highest": _finite(np.nanmax(height)), "lowest": _finite(np.nanmin(height))}
    if velocity is not None and len(velocity):
        found["greatest_speed"] = _finite(np.nanmax(np.hypot(velocity.value[:, 0], velocity.value[:, 1])))
        found["greatest_climb"] = _finite(np.nanmax(velocity.value[:, 2]))
    if battery is not None and len(battery):
        found["least_voltage"] = _finite(np.nanmin(battery.value[:, 0]))
    lasted: dict[str, float] = {}
    for start, stop, mode in spans(vehicle.modes, end):
        lasted[mode] = lasted.get(mode, 0.0) + stop - start
    return found | {"modes": lasted, "warnings": sum(bad <= 4 for _, bad, _ in vehicle.texts)}


def way_length(place: Series, grain: float = 0.1) -> float:
    """Return how long the way of a vehicle is, m; noise below ``grain``, m, does not count.

    Args:
        place: m, shape (t, 3).
        grain: a place counts when it is so far from the last that counted.
    """
    good = place.value[np.isfinite(place.value).all(axis=1)]
    if not len(good):
        return 0.0
    total, last = 0.0, good[0]
    at = 0
    while True:
        # the next place far enough away, looked for in ever larger parts
        size = 64
        while True:
            away = np.linalg.norm(good[at : at + size] - last, axis=1)
            far = np.flatnonzero(away >= grain)
            if far.size or at + size >= len(good):
                break
            size *= 8
        if not far.size:
            return total
        at += int(far[0])
        total += float(away[far[0]])
        last = good[at]


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None


def flight_page(flight: Flight, figures: dict[str, Any]) -> Page:
    """Return the words of a recording's report."""
    page = Page(f"Flight in {flight.path.name}", _sentence(flight, figures), list(figures["notes"]))
    if figures["formation"]:
        page.tables.append(_formation(figures["formation"]))
        page.notes += figures["formation"]["shortcomings"]
    elif flight.collisions:
        page.notes += flight.collisions
    page.tables += [_vehicles(figures), _modes(figures)]
    page.tables += [table for table in (_texts(flight), _log(flight)) if table.rows]
    page.tables.append(topics_table(flight))
    return page


def _sentence(flight: Flight, figures: dict[str, Any]) -> str:
    words = f"{len(flight.vehicles)} vehicles" if len(flight.vehicles) != 1 else "1 vehicle"
    text = f"{words}, {len(flight.topics)} topics, {figures['messages']} messages in {flight.duration:.1f} s"
    text += f", {flight.size / 1e6:.1f} MB."
    if flight.origin:
        text += f" It began at {time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(flight.origin))} UTC."
    if figures["formation"]:
        text += f" The formation flight ended with {figures['formation']['outcome']!r}; judged by "
        text += f"{figures['formation']['positions']}, the least distance was "
        text += f"{figures['formation']['least_distance']:.2f} m."
    return text


def _number(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _formation(report: dict[str, Any]) -> Table:
    rows = [
        (
            item["pattern"],
            f"{item['command_time']:.1f}",
            "never" if item["settling_time"] is None else f"{item['settling_time']:.2f}",
            f"{item['overshoot']:.2f}",
            f"{item['steady_error_mean']:.3f}",
            f"{item['steady_error_max']:.3f}",
            f"{item['least_distance']:.2f}",
            f"{item['assigned_distance']:.2f}",
            f"{item['optimal_distance']:.2f}",
        )
        for item in report["reconfigurations"]
    ]
    # Broken so that all of it fits into 80 columns.
    head = ("pattern", "told\nat (s)", "settled\nafter\n(s)", "overshoot\n(m)", "steady\nmean\n(m)", "steady\nmax\n(m)",
            "least\ngap\n(m)", "assigned\n(m)", "optimum\n(m)")  # fmt: skip
    return Table("Formation", head, rows)


def _vehicles(figures: dict[str, Any]) -> Table:
    rows = [
        (
            name,
            _number(item["armed_time"], 1),
            _number(item["way"], 1),
            _number(item["highest"]),
            _number(item["greatest_speed"]),
            _number(item["greatest_climb"]),
            _number(item["least_voltage"]),
            str(item["warnings"]),
        )
        for name, item in figures["vehicles"].items()
    ]
    head = ("vehicle", "armed (s)", "way (m)", "highest (m)", "fastest (m/s)", "fastest climb (m/s)",
            "least voltage (V)", "warnings")  # fmt: skip
    return Table("Vehicles", head, rows, long=len(rows) > 60)


def _modes(figures: dict[str, Any]) -> Table:
    rows = [
        (name, ", ".join(f"{mode} {seconds:.1f}" for mode, seconds in item["modes"].items()))
        for name, item in figures["vehicles"].items()
    ]
    return Table("Seconds in each mode", ("vehicle", "modes (s)"), rows, long=True, texts=frozenset({1}))


def _texts(flight: Flight) -> Table:
    rows = sorted((at, vehicle.name, bad, text) for vehicle in flight.vehicles for at, bad, text in vehicle.texts)
    cells = [(f"{at:.2f}", name, _severity(bad), text) for at, name, bad, text in rows]
    return _shortened("Texts of the autopilots", ("time (s)", "vehicle", "severity", "text"), cells)


def _severity(number: int) -> str:
    return _SEVERITIES[number] if 0 <= number < len(_SEVERITIES) else str(number)


def _log(flight: Flight) -> Table:
    cells = [(f"{at:.2f}", node, _LEVELS.get(level, str(level)), text) for at, level, node, text in flight.log]
    return _shortened("Warnings of nodes", ("time (s)", "node", "level", "text"), cells)


def _shortened(title: str, head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> Table:
    if len(rows) > _MOST_ROWS:
        title = f"{title} (the first {_MOST_ROWS} of {len(rows)})"
    return Table(title, head, rows[:_MOST_ROWS], long=len(rows) > 20, texts=frozenset(range(1, len(head))))


def topics_table(flight: Flight) -> Table:
    """Return the table of what was recorded."""
    rows = [
        (
            topic.name,
            topic.type,
            str(topic.count),
            "" if math.isnan(topic.rate) else f"{topic.rate:.1f}",
            f"{topic.bytes / 1e6:.3f}",
            str(topic.publishers),
        )
        for topic in flight.topics
    ]
    head = ("topic", "type", "messages", "rate (Hz)", "MB", "publishers")
    return Table(f"Topics ({len(rows)})", head, rows, long=True, texts=frozenset({1}))
