"""Page and pictures of two or more runs, or a run and a reference, on the same axes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from matplotlib.figure import Figure

from xtdrone_interaction.metrics.comparison import ComparedRun, RunDifference, difference, speed
from xtdrone_interaction.metrics.setpoint_tracking import SetpointPair, pairs
from xtdrone_interaction.metrics.vehicle_metrics import least_distance_series
from xtdrone_interaction.pictures.picture_style import NamedFigure, line, name_lines, panels, shades
from xtdrone_interaction.report.html_page import ReportPage
from xtdrone_interaction.report.report_tables import ReportTable, number

_MOST_VEHICLES = 9  # with a picture each


def pictures(runs: Sequence[ComparedRun], time_name: str) -> Iterator[NamedFigure]:
    """Yield the pictures of runs on the same axes, each drawn when it is asked for."""
    for name in list(runs[0].places)[:_MOST_VEHICLES]:
        yield NamedFigure(f"positions_{name}", f"Positions of {name}", _positions(runs, name, time_name))
    found = [(run, made) for run in runs[1:] if (made := difference(runs[0], run)) is not None]
    if found:
        yield NamedFigure("difference", f"Distance from {runs[0].name}", _differences(runs, found, time_name))
    if len(runs[0].places) > 1:
        yield NamedFigure("distances", "Minimum distance between vehicles", _distances(runs, time_name))
    logs = [run for run in runs if run.log is not None]
    if len(logs) == len(runs):
        for what in ("Velocity", "Attitude", "Rates"):
            groups = [pairs(run.log).get(what, []) for run in logs if run.log is not None]
            if all(groups):
                yield NamedFigure(what.lower(), what, _responses(logs, groups, what))


def _first_width(run: ComparedRun, runs: Sequence[ComparedRun]) -> float:
    """Return the line width of a run: the first one's is wide, so that equal runs do not hide it."""
    return 2.6 if run is runs[0] else 1.0


def _positions(runs: Sequence[ComparedRun], vehicle: str, time_name: str) -> Figure:
    figure, axes = panels(4, 2.0, 0.8)
    for run, shade in zip(runs, shades(len(runs)), strict=True):
        series = run.places[vehicle]
        width = _first_width(run, runs)
        for axis in range(3):
            line(axes[axis], series.time, series.value[:, axis], color=shade, lw=width, label=run.name)
        fast = speed(series)
        line(axes[3], fast.time, fast.value[:, 0], color=shade, lw=width)
    for panel, name in zip(axes, ("x, east [m]", "y, north [m]", "z, up [m]", "speed [m/s]"), strict=True):
        panel.set_ylabel(name)
    axes[-1].set_xlabel(time_name)
    figure.suptitle(f"Positions and speed of {vehicle}")
    name_lines(figure, axes[0], 0.81)
    return figure


def _differences(
    runs: Sequence[ComparedRun], found: Sequence[tuple[ComparedRun, RunDifference]], time_name: str
) -> Figure:
    several = len(runs[0].places) > 1
    figure, axes = panels(1 + several, 2.6, 0.8)
    colour = dict(zip([run.name for run in runs], shades(len(runs)), strict=True))
    for run, made in found:
        line(axes[0], made.time, made.distance.max(axis=1), color=colour[run.name], lw=0.9, label=run.name)
        if several:
            line(axes[1], made.time, made.distance.mean(axis=1), color=colour[run.name], lw=0.9)
    axes[0].set(ylabel="greatest [m]" if several else "distance [m]", ylim=(0.0, None))
    if several:
        axes[1].set(ylabel="mean of the vehicles [m]", ylim=(0.0, None))
    axes[-1].set_xlabel(time_name)
    figure.suptitle(f"Distance from the places in {runs[0].name}")
    name_lines(figure, axes[0], 0.81)
    return figure


def _distances(runs: Sequence[ComparedRun], time_name: str) -> Figure:
    figure, (panel,) = panels(1, 3.2, 0.8)
    for run, shade in zip(runs, shades(len(runs)), strict=True):
        close = least_distance_series(run.places.values())
        if close is not None:
            line(panel, close.time, close.value[:, 0], color=shade, lw=_first_width(run, runs), label=run.name)
    panel.set(ylabel="minimum distance [m]", xlabel=time_name, ylim=(0.0, None))
    figure.suptitle("Minimum distance between any two vehicles")
    name_lines(figure, panel, 0.81)
    return figure


def _responses(runs: Sequence[ComparedRun], groups: Sequence[Sequence[SetpointPair]], what: str) -> Figure:
    """Draw responses of flight logs on the same axes; times count from each one's arming."""
    figure, axes = panels(len(groups[0]), 2.2, 0.8)
    for run, group, shade in zip(runs, groups, shades(len(runs)), strict=True):
        zero = run.log.flown[0] if run.log is not None else 0.0
        for panel, pair in zip(axes, group, strict=True):
            width = _first_width(run, runs)
            line(panel, pair.actual.time - zero, pair.actual.value[:, 0], color=shade, lw=width, label=run.name)
            panel.set_ylabel(pair.name)
    axes[-1].set_xlabel("time since the first arming [s]")
    figure.suptitle(f"{what}, responses")
    name_lines(figure, axes[0], 0.81)
    return figure


def compare_page(runs: Sequence[ComparedRun], metrics: Sequence[dict[str, Any]], note: str) -> ReportPage:
    """Return the report of a comparison without its pictures."""
    vehicles = list(runs[0].places)
    what = vehicles[0] if len(vehicles) == 1 else f"{len(vehicles)} vehicles"
    page = ReportPage(f"Comparison of {', '.join(run.name for run in runs)}", f"{what}; {note}. Beside {runs[0].name}.")
    page.notes += [f"{run.name}: {text}" for run in runs for text in run.notes]
    if len(vehicles) > _MOST_VEHICLES:
        page.notes.append(f"of {len(vehicles)} vehicles the first {_MOST_VEHICLES} are drawn one by one")

    keys = ("duration", "way", "greatest_speed", "least_distance", "difference_rms", "difference_greatest",
            "difference_time")  # fmt: skip
    rows = [(row["name"], *(number(row[key]) for key in keys)) for row in metrics]
    head = ("run", "time (s)", "path (m)", "max. speed (m/s)", "minimum distance (m)", "difference, RMS (m)",
            "maximum (m)", "at (s)")  # fmt: skip
    page.tables.append(ReportTable("Runs", head, rows))
    flown = [run for run in runs if run.patterns]
    if flown:
        most = max(flown, key=lambda run: len(run.patterns))
        lines = []
        for i, item in enumerate(most.patterns):
            cells = [_settled(run.patterns[i]) if i < len(run.patterns) else "" for run in flown]
            lines.append((str(item["pattern"]), *cells))
        names = ("pattern", *(run.name for run in flown))
        page.tables.append(ReportTable("Settled after (s), steady error (m)", names, lines))
    return page


def _settled(item: dict[str, Any]) -> str:
    after = "never" if item["settling_time"] is None else f"{item['settling_time']:.2f}"
    return f"{after}, {item['steady_error_mean']:.3f}"
