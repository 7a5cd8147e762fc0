"""The benchmark's tables on the terminal."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from benchmarks.calibration import describe
from benchmarks.measurement_runner import Row
from benchmarks.measurement_table import MEASUREMENTS, Measurement

MIN_CPU = 0.005  # CPU s per simulated s; programs that never use more have no line


def print_results(results: dict[str, Any], console: Console) -> None:
    """Print a table for each part that was measured, then the notes on doubtful figures."""
    caption = describe(results["calibration"]) if "calibration" in results else None
    for part, measurement in MEASUREMENTS.items():
        if results.get(part):
            table = part_table(measurement, results[part])
            table.caption, table.caption_justify = caption, "left"
            console.print(table)
    if any("trials" in row for row in results.get("free", [])):
        console.print(trial_table(results["free"]))
    if _cpu_groups(results):
        console.print(cpu_table(results))
    for line in caveats(results):
        console.print(f"[yellow]Note:[/yellow] {line}", highlight=False)


def part_table(measurement: Measurement, rows: Sequence[Row]) -> Table:
    """Return the table of one part; repeated measurements share a line with their median."""
    table = Table(title=measurement.title, title_justify="left", title_style="bold")
    columns = (measurement.first, *measurement.fields)
    for heading, _ in columns:
        table.add_column(heading, justify="right")
    for group in grouped(measurement, rows):
        good = [row for row in group if "error" not in row]
        if good:
            table.add_row(*(cell(good) for _, cell in columns))
        else:
            table.add_row(measurement.first[1](group), *["failed"] * (len(columns) - 1))
    return table


def cpu_table(results: dict[str, Any]) -> Table:
    """Return CPU seconds per simulated second by program, a column for each flight or stack that was measured."""
    groups = _cpu_groups(results)
    use = [{name: _median_cpu(rows, name) for name in _programs(rows)} for _, rows in groups]
    most: dict[str, float] = {}
    for programs in use:
        for name, seconds in programs.items():
            most[name] = max(most.get(name, 0.0), seconds)
    shown = sorted((name for name in most if most[name] >= MIN_CPU), key=lambda name: -most[name])
    table = Table(title="CPU s per simulated s", title_justify="left", title_style="bold")
    table.add_column("program")
    for label, _ in groups:
        table.add_column(label, justify="right")
    for name in shown:
        table.add_row(name, *(f"{programs[name]:.3f}" if name in programs else "" for programs in use))
    table.add_row("all", *(f"{sum(programs.values()):.3f}" for programs in use), style="bold")
    return table


def trial_table(rows: Sequence[Row]) -> Table:
    """Return the table of the speeds tried by free-running flights: speed reached, share of messages by role."""
    table = Table(
        title="Free-running: messages published, of those in lockstep", title_justify="left", title_style="bold"
    )
    trials = [(row["vehicles"], trial) for row in rows for trial in row.get("trials", [])]
    roles = list(dict.fromkeys(role for _, trial in trials for role in trial["turns"]))
    for name in ("vehicles", "target", "reached", *roles, "kept\nup"):
        table.add_column(name, justify="right")
    for vehicles, trial in sorted(trials, key=lambda item: (item[0], item[1]["speed"])):
        reached = trial["real_time_factor"]
        table.add_row(
            str(vehicles),
            f"{trial['speed']:.2f} x",
            f"{reached:.2f} x" if reached else "broke off",
            *(f"{trial['turns'][role]:.0%}" if role in trial["turns"] else "" for role in roles),
            "yes" if trial["good"] else "no",
        )
    return table


def caveats(results: dict[str, Any]) -> list[str]:
    """Return notes on doubtful figures: load before, other programs, failures, phases that did not settle."""
    lines = []
    load = results["machine"]["load_before"][0]
    if load > 1.0:
        lines.append(
            f"the machine's load average was {load:.1f} before the benchmark began: other programs were running"
        )
    for part, measurement in MEASUREMENTS.items():
        for row in results.get(part, []):
            label = f"{part}, {measurement.label(row)}"
            if "error" in row:
                lines.append(f"{label}: failed: {_escape(row['error'])}")
            if row.get("others_cpu", 0.0) > 0.2:
                lines.append(f"{label}: other programs took {row['others_cpu']:.1f} cores meanwhile")
            if row.get("exact_share", 1.0) is None:
                lines.append(f"{label}: free-running, the nodes kept up at none of the speeds tried")
            if row.get("dropped"):
                lines.append(f"{label}: the detector skipped {row['dropped']} of the images")
            if row.get("unsettled"):
                lines.append(f"{label}: did not settle: {', '.join(row['unsettled'])}")
    return lines


def short_result(part: str, row: Row) -> str:
    """Return the main figures of a measurement as text."""
    if "error" in row:
        return f"failed: {row['error']}"
    return MEASUREMENTS[part].summary(row)


def grouped(measurement: Measurement, rows: Iterable[Row]) -> list[list[Row]]:
    """Return the rows of each case together, in the order of the first ones."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(measurement.label(row), []).append(row)
    return list(groups.values())


def _cpu_groups(results: dict[str, Any]) -> list[tuple[str, list[Row]]]:
    """Return heading and rows with ``cpu_per_simulated_second`` of each flight or stack that was measured."""
    groups = [
        (f"{prefix}{MEASUREMENTS[part].label(rows[0])}", rows)
        for part, prefix in (("stack", "stack "), ("sensing", ""), ("formation", ""), ("search", "search "))
        for group in grouped(MEASUREMENTS[part], results.get(part, []))
        if (rows := [row for row in group if "cpu_per_simulated_second" in row])
    ]
    for group in grouped(MEASUREMENTS["free"], results.get("free", [])):
        for label, key in (("exact", "exact_cpu"), ("free", "free_cpu")):
            rows = [{"cpu_per_simulated_second": row[key]} for row in group if row.get(key)]
            if rows:
                groups.append((f"{group[0]['vehicles']} {label}", rows))
    return groups


def _programs(rows: Sequence[Row]) -> dict[str, None]:
    return {name: None for row in rows for name in row["cpu_per_simulated_second"]}


def _median_cpu(rows: Sequence[Row], name: str) -> float:
    return statistics.median(row["cpu_per_simulated_second"].get(name, 0.0) for row in rows)


def _escape(text: str) -> str:
    return text.replace("[", r"\[")
