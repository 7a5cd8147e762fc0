"""The benchmark's tables."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

Row = dict[str, Any]

# Real-time factors to reach, by part, number of vehicles and processes.
GOALS: dict[tuple[str, int, str | None], float] = {
    ("core", 9, None): 30.0,
    ("core", 100, None): 6.0,
    ("stack", 9, None): 10.0,
    ("formation", 9, "per_uav"): 3.0,
    ("formation", 30, "per_uav"): 1.0,
}
LEAST_CPU = 0.005  # CPU s per simulated s; programs that never use more have no column

_TITLES = {
    "core": "Core: physics, sensors, autopilots; no ROS",
    "stack": "Stack: simulator, MAVROS layer, one client",
    "formation": "Formation flight",
}


def print_results(results: dict[str, Any], console: Console) -> None:
    """Print a table for each part that was measured, then what puts the figures in doubt."""
    for part, title in _TITLES.items():
        if results.get(part):
            console.print(part_table(part, title, results[part]))
    measured = [row for part in ("stack", "formation") for row in results.get(part, [])]
    if any("cpu_per_simulated_second" in row for row in measured):
        console.print(cpu_table(results))
    for line in caveats(results):
        console.print(f"[yellow]Note:[/yellow] {line}", highlight=False)


def part_table(part: str, title: str, rows: Sequence[Row]) -> Table:
    """Return the table of one part; repeated measurements share a line with their median."""
    table = Table(title=title, title_justify="left", title_style="bold")
    columns = _COLUMNS[part]
    for name, _ in columns:
        table.add_column(name, justify="right")
    for group in grouped(rows):
        good = [row for row in group if "error" not in row]
        if good:
            table.add_row(*(cell(part, good) for _, cell in columns))
        else:
            table.add_row(_vehicles(part, group), *["failed"] * (len(columns) - 1))
    return table


def cpu_table(results: dict[str, Any]) -> Table:
    """Return CPU seconds per simulated second by program, a line for each measurement of stack and formation."""
    groups = [
        (part, good)
        for part in ("stack", "formation")
        for group in grouped(results.get(part, []))
        if (good := [row for row in group if "cpu_per_simulated_second" in row])
    ]
    use = [{name: _median_cpu(good, name) for name in _programs(good)} for _, good in groups]
    most: dict[str, float] = {}
    for programs in use:
        for name, seconds in programs.items():
            most[name] = max(most.get(name, 0.0), seconds)
    shown = sorted((name for name in most if most[name] >= LEAST_CPU), key=lambda name: -most[name])
    table = Table(title="CPU s per simulated s", title_justify="left", title_style="bold")
    table.add_column("program")
    for part, good in groups:
        table.add_column(_label(part, good[0]), justify="right")
    for name in shown:
        table.add_row(name, *(f"{programs[name]:.3f}" if name in programs else "" for programs in use))
    table.add_row("all", *(f"{sum(programs.values()):.3f}" for programs in use), style="bold")
    return table


def caveats(results: dict[str, Any]) -> list[str]:
    """Return what puts the figures in doubt: load before, other programs, failures, phases that did not settle."""
    lines = []
    load = results["machine"]["load_before"][0]
    if load > 1.0:
        lines.append(f"the machine's load average was {load:.1f} before the benchmark began: it had other work to do")
    for part in _TITLES:
        for row in results.get(part, []):
            label = f"{part}, {row['vehicles']} {row.get('mode', '').replace('_', '-')}".rstrip()
            if "error" in row:
                lines.append(f"{label}: failed: {_escape(row['error'])}")
            if row.get("others_cpu", 0.0) > 0.2:
                lines.append(f"{label}: other programs took {row['others_cpu']:.1f} cores meanwhile")
            if row.get("unsettled"):
                lines.append(f"{label}: did not settle: {', '.join(row['unsettled'])}")
    return lines


def short_result(row: Row) -> str:
    """Return a measurement's main figure as text."""
    if "error" in row:
        return f"failed: {row['error']}"
    return f"{row['real_time_factor']:.2f} x real time"


def grouped(rows: Iterable[Row]) -> list[list[Row]]:
    """Return the rows of equal vehicles and mode together, in the order of their first."""
    groups: dict[tuple[int, str | None], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["vehicles"], row.get("mode")), []).append(row)
    return list(groups.values())


def _programs(rows: Sequence[Row]) -> dict[str, None]:
    return {name: None for row in rows for name in row["cpu_per_simulated_second"]}


def _median_cpu(rows: Sequence[Row], name: str) -> float:
    return statistics.median(row["cpu_per_simulated_second"].get(name, 0.0) for row in rows)


def _label(part: str, row: Row) -> str:
    words = [str(row["vehicles"]), row.get("mode", "").replace("_", "-")]
    return " ".join(([part] if part == "stack" else []) + [word for word in words if word])


def _escape(text: str) -> str:
    return text.replace("[", r"\[")


def _vehicles(part: str, rows: Sequence[Row]) -> str:
    return str(rows[0]["vehicles"]) if part != "formation" else _label(part, rows[0])


def _factor(part: str, rows: Sequence[Row]) -> str:
    """Return the median factor, and the range where there is more than one."""
    values = [row["real_time_factor"] for row in rows]
    text = f"{statistics.median(values):.2f} x"
    return text if len(values) == 1 else f"{text}\n{min(values):.2f} to {max(values):.2f}"


def _goal(part: str, rows: Sequence[Row]) -> str:
    goal = GOALS.get((part, rows[0]["vehicles"], rows[0].get("mode")))
    return f"{goal:g} x" if goal is not None else ""


def _median(key: str, form: str, scale: float = 1.0) -> Callable[[str, Sequence[Row]], str]:
    def cell(_: str, rows: Sequence[Row]) -> str:
        return format(statistics.median(row[key] for row in rows) * scale, form)

    return cell


def _flown(_: str, rows: Sequence[Row]) -> str:
    return f"{statistics.median(row['flight']['simulated'] for row in rows):.1f}"


_Cell = Callable[[str, Sequence[Row]], str]
_SPEED: list[tuple[str, _Cell]] = [("vehicles", _vehicles), ("real-time\nfactor", _factor), ("to\nreach", _goal)]
_PROCESSES: list[tuple[str, _Cell]] = [
    ("start-up\ns", _median("startup_seconds", ".1f")),
    ("memory\nMB", _median("memory_bytes", ".0f", 1e-6)),
    ("processes", _median("processes", ".0f")),
]
_COLUMNS: dict[str, list[tuple[str, _Cell]]] = {
    "core": [
        *_SPEED,
        ("vehicle-steps/s", _median("vehicle_steps_per_second", ".0f")),
        ("us/vehicle-step", _median("microseconds_per_vehicle_step", ".2f")),
    ],
    "stack": [*_SPEED, ("messages/s", _median("messages_per_second", ".0f")), *_PROCESSES],
    "formation": [*_SPEED, ("simulated\ns", _flown), *_PROCESSES],
}
