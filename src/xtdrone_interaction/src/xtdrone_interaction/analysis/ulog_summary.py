"""Figures of a flight log, as plain data and as the tables of its report."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from xtdrone_interaction.analysis.columns import Series
from xtdrone_interaction.analysis.drawing import spans
from xtdrone_interaction.analysis.page import Page, Table
from xtdrone_interaction.analysis.summary import way_length
from xtdrone_interaction.analysis.ulog import FlightLog
from xtdrone_interaction.analysis.ulog_pictures import trackings

_INFO = ("sys_name", "release", "ver_hw", "ver_sw_release", "ver_sw", "sys_uuid")
_MOST_ROWS = 300


def summarise(log: FlightLog) -> dict[str, Any]:
    """Return the figures of a flight log as plain data, ready for JSON."""
    place = _flown(log, "x", "y", "z")
    moving = _flown(log, "vx", "vy", "vz")
    voltage = log.series("battery_status", "voltage_v")
    figures: dict[str, Any] = {
        "file": str(log.path),
        "bytes": log.size,
        "duration": log.duration,
        "cut_off": log.cut,
        "notes": log.notes,
        "vehicle": {key: log.info[key] for key in _INFO if key in log.info},
        "armed_time": sum(end - start for start, end, armed in spans(log.armed, log.duration) if armed),
        "way": None,
        "highest": None,
        "greatest_speed": None,
        "least_voltage": None,
        "modes": {},
        "tracking": [{"what": what, **asdict(found)} for what, found in trackings(log)],
    }
    if place is not None:
        figures |= {
            "way": way_length(place),
            "highest": float(np.max(place.value[0, 2] - place.value[:, 2])),
        }
    if moving is not None:
        figures["greatest_speed"] = float(np.max(np.hypot(moving.value[:, 0], moving.value[:, 1])))
    if voltage is not None and np.isfinite(voltage.value).any():
        figures["least_voltage"] = float(np.nanmin(voltage.value))
    for start, end, mode in spans(log.modes, log.duration):
        figures["modes"][mode] = figures["modes"].get(mode, 0.0) + end - start
    return figures


def _flown(log: FlightLog, *fields: str) -> Series | None:
    """Return fields of the local position from the first arming to the last disarming; before it may not be known."""
    series = log.series("vehicle_local_position", *fields)
    if series is None:
        return None
    start, end = log.flown
    part = (series.time >= start) & (series.time <= end) & np.isfinite(series.value).all(axis=1)
    return Series(series.time[part], series.value[part]) if part.any() else None


def log_page(log: FlightLog, figures: dict[str, Any]) -> Page:
    """Return the words of a flight log's report."""
    text = f"{log.duration:.1f} s, armed for {figures['armed_time']:.1f} s, {log.size / 1e6:.1f} MB, "
    text += f"{len(log.counts)} topics."
    if figures["way"] is not None and figures["armed_time"] > 0:
        text += f" It flew {figures['way']:.1f} m, {figures['highest']:.1f} m above where it began"
        text += "." if figures["greatest_speed"] is None else f", at up to {figures['greatest_speed']:.1f} m/s."
    text += _logged_by(figures["vehicle"])
    page = Page(f"Flight log {log.path.name}", text, list(log.notes))
    page.tables.append(_tracking(log, figures))
    page.tables.append(
        Table("Seconds in each mode", ("mode", "time (s)"), [(m, f"{s:.1f}") for m, s in figures["modes"].items()])
    )
    texts = [(f"{time:.2f}", severity, text) for time, severity, text in log.texts]
    if texts:
        more = f" (the first {_MOST_ROWS} of {len(texts)})" if len(texts) > _MOST_ROWS else ""
        page.tables.append(
            Table(f"Texts{more}", ("time (s)", "severity", "text"), texts[:_MOST_ROWS], long=len(texts) > 20,
                  texts=frozenset({1, 2}))
        )  # fmt: skip
    changed = [(name, f"{value:g}", "" if usual is None else f"{usual:g}") for name, value, usual in log.changed]
    if changed:
        page.tables.append(
            Table(f"Changed parameters ({len(changed)})", ("name", "value", "default"), changed, long=True)
        )
    rows = [(name, str(instance), str(count)) for (name, instance), count in sorted(log.counts.items())]
    page.tables.append(Table(f"Topics ({len(rows)})", ("topic", "instance", "messages"), rows, long=True))
    return page


def _logged_by(vehicle: dict[str, Any]) -> str:
    """Return which software logged on what, as far as it is known."""
    words = " ".join(str(vehicle[key]) for key in ("sys_name", "release") if key in vehicle)
    if "ver_hw" in vehicle:
        words += f" on {vehicle['ver_hw']}"
    if "ver_sw" in vehicle:
        words += f" (git {str(vehicle['ver_sw'])[:10]})"
    return f" Logged by {words.strip()}." if words else ""


def _tracking(log: FlightLog, figures: dict[str, Any]) -> Table:
    rows = [
        (
            f"{item['what'].lower()}, {item['name']}",
            f"{item['rms']:.3f}",
            f"{item['greatest']:.3f}",
            "" if item["delay"] is None else f"{1e3 * item['delay']:.0f}",
        )
        for item in figures["tracking"]
    ]
    title = f"Setpoint and response {log.flown_words}"
    return Table(title, ("quantity", "error, RMS", "greatest", "delay (ms)"), rows)
