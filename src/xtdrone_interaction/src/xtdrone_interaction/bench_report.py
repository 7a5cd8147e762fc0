"""The benchmark's tables."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

Row = dict[str, Any]
_Cell = Callable[[str, Sequence[Row]], str]

# To reach, by part, number of vehicles (workers, Hz) and processes: real-time factors; of the drawing pictures a
# second, of the sweep the speed-up, of the analysis MB a second, of the free part the share of the free speed.
GOALS: dict[tuple[str, int, str | None], float] = {
    ("core", 9, None): 30.0,
    ("core", 100, None): 6.0,
    ("simplified", 9, None): 1000.0,
    ("simplified", 1000, None): 1.0,
    ("drawing", 100, None): 15.0,
    ("sweep", 2, None): 1.7,
    ("analyse", 1000, None): 100.0,
    ("stack", 9, None): 10.0,
    ("formation", 9, "per_uav"): 3.0,
    ("formation", 30, "per_uav"): 1.0,
    ("search", 2, None): 1.0,
    ("free", 9, None): 0.7,
}
LEAST_CPU = 0.005  # CPU s per simulated s; programs that never use more have no column

_TITLES = {
    "core": "Core: physics, sensors, autopilots; no ROS",
    "simplified": "Simplified simulator: vehicles, consensus, avoidance; no ROS, one core",
    "drawing": "Drawing of the simplified simulator, off-screen",
    "sweep": "Sweep: flights of nine simplified vehicles through three patterns",
    "detector": "Detector of people on one core, by the width of its input",
    "renderer": "Pictures of the world outdoor, one process",
    "rviz": "Films of rviz without a screen, the formation's view; CPU ms per frame",
    "analyse": "Analysis of a bag of poses, velocities and states, not packed",
    "barrier": "Barrier of the lockstep, participants that do nothing: us per tick",
    "stack": "Stack: simulator, MAVROS layer, one client",
    "formation": "Formation flight",
    "search": "Search with six cameras, film and bag; shares of its CPU time",
    "free": "Formation in lockstep, and free-running",
}


def print_results(results: dict[str, Any], console: Console) -> None:
    """Print a table for each part that was measured, then what puts the figures in doubt."""
    for part, title in _TITLES.items():
        if results.get(part):
            console.print(part_table(part, title, results[part]))
    if any("trials" in row for row in results.get("free", [])):
        console.print(trial_table(results["free"]))
    if _cpu_groups(results):
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
            table.add_row(columns[0][1](part, group), *["failed"] * (len(columns) - 1))
    return table


def cpu_table(results: dict[str, Any]) -> Table:
    """Return CPU seconds per simulated second by program, a column for each flight or stack that was measured."""
    groups = _cpu_groups(results)
    use = [{name: _median_cpu(rows, name) for name in _programs(rows)} for _, rows in groups]
    most: dict[str, float] = {}
    for programs in use:
        for name, seconds in programs.items():
            most[name] = max(most.get(name, 0.0), seconds)
    shown = sorted((name for name in most if most[name] >= LEAST_CPU), key=lambda name: -most[name])
    table = Table(title="CPU s per simulated s", title_justify="left", title_style="bold")
    table.add_column("program")
    for label, _ in groups:
        table.add_column(label, justify="right")
    for name in shown:
        table.add_row(name, *(f"{programs[name]:.3f}" if name in programs else "" for programs in use))
    table.add_row("all", *(f"{sum(programs.values()):.3f}" for programs in use), style="bold")
    return table


def trial_table(rows: Sequence[Row]) -> Table:
    """Return the speeds that free-running flights tried: what was reached, and the share of messages by role."""
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
    """Return what puts the figures in doubt: load before, other programs, failures, phases that did not settle."""
    lines = []
    load = results["machine"]["load_before"][0]
    if load > 1.0:
        lines.append(f"the machine's load average was {load:.1f} before the benchmark began: it had other work to do")
    for part in _TITLES:
        for row in results.get(part, []):
            label = f"{part}, {_label('', row)}"
            if "error" in row:
                lines.append(f"{label}: failed: {_escape(row['error'])}")
            if row.get("others_cpu", 0.0) > 0.2:
                lines.append(f"{label}: other programs took {row['others_cpu']:.1f} cores meanwhile")
            if row.get("exact_share", 1.0) is None:
                lines.append(f"{label}: free-running, nodes kept up at no speed that was tried")
            if row.get("dropped"):
                lines.append(f"{label}: the detector passed over {row['dropped']} of the pictures")
            if row.get("unsettled"):
                lines.append(f"{label}: did not settle: {', '.join(row['unsettled'])}")
    return lines


def short_result(row: Row) -> str:
    """Return a measurement's main figure as text."""
    if "error" in row:
        return f"failed: {row['error']}"
    if "median_us" in row:
        return f"{row['median_us']:.0f} us per tick"
    if "exact_share" in row:
        exact, free = row["exact_real_time_factor"], row["free_real_time_factor"]
        return f"{exact:.2f} x real time, free-running {free:.2f} x"
    if "pictures_per_second" in row:
        return f"{row['pictures_per_second']:.1f} pictures a second"
    if "frames_per_second" in row:
        return f"{row['frames_per_second']:.1f} frames a second"
    if "milliseconds" in row:
        return f"{row['milliseconds']:.1f} ms a picture"
    if "megabytes_per_second" in row:
        return f"{row['megabytes_per_second']:.0f} MB/s, {row['memory_bytes'] * 1e-6:.0f} MB of memory"
    if "speed_up" in row:
        return f"{row['runs_per_second']:.1f} runs a second, {row['speed_up']:.2f} x those of one worker"
    return f"{row['real_time_factor']:.2f} x real time"


def grouped(rows: Iterable[Row]) -> list[list[Row]]:
    """Return rows of equal vehicles (participants, ...) and mode (kind) together, in the order of their first."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(_label("", row), []).append(row)
    return list(groups.values())


def _cpu_groups(results: dict[str, Any]) -> list[tuple[str, list[Row]]]:
    """Return heading and rows with ``cpu_per_simulated_second`` of each flight or stack that was measured."""
    groups = [
        (_label(part, rows[0]), rows)
        for part in ("stack", "formation", "search")
        for group in grouped(results.get(part, []))
        if (rows := [row for row in group if "cpu_per_simulated_second" in row])
    ]
    for group in grouped(results.get("free", [])):
        for label, key in (("exact", "exact_cpu"), ("free", "free_cpu")):
            rows = [{"cpu_per_simulated_second": row[key]} for row in group if row.get(key)]
            if rows:
                groups.append((f"{group[0]['vehicles']} {label}", rows))
    return groups


def _programs(rows: Sequence[Row]) -> dict[str, None]:
    return {name: None for row in rows for name in row["cpu_per_simulated_second"]}


def _median_cpu(rows: Sequence[Row], name: str) -> float:
    return statistics.median(row["cpu_per_simulated_second"].get(name, 0.0) for row in rows)


def _label(part: str, row: Row) -> str:
    if "kind" in row:
        words = [str(row["participants"]), row["kind"]]
    elif "workers" in row:
        words = [f"{row['workers']} workers"]
    elif "backend" in row:
        words = [f"{row['width']} x {row['height']} px,", row["backend"]]
    elif "antialiasing" in row:
        words = [
            f"{row['vehicles']} vehicles, {row['width']} x {row['height']} px{'' if row['antialiasing'] else ', rough'}"
        ]
    elif "megabytes" in row:
        words = [f"{row['megabytes']} MB"]
    elif "camera_rate" in row:
        words = [f"{row['camera_rate']} Hz"]
    elif "width" in row:
        words = [f"{row['width']} px wide"]
    else:
        words = [str(row["vehicles"]), row.get("mode", "").replace("_", "-")]
    return " ".join(([part] if part in ("stack", "search") else []) + [word for word in words if word])


def _escape(text: str) -> str:
    return text.replace("[", r"\[")


def _vehicles(part: str, rows: Sequence[Row]) -> str:
    return str(rows[0]["vehicles"]) if part != "formation" else _label(part, rows[0])


def _participants(_: str, rows: Sequence[Row]) -> str:
    return _label("", rows[0]) if rows[0]["participants"] else "0"


def _label_only(_: str, rows: Sequence[Row]) -> str:
    return _label("", rows[0])


def _input_size(_: str, rows: Sequence[Row]) -> str:
    return " x ".join(str(rows[0][side]) for side in ("width", "height") if side in rows[0])


def _workers(_: str, rows: Sequence[Row]) -> str:
    return str(rows[0]["workers"])


def _factor(part: str, rows: Sequence[Row]) -> str:
    return _with_range("real_time_factor", rows, " x")


def _with_range(key: str, rows: Sequence[Row], unit: str) -> str:
    """Return the median, and the range where there is more than one value; empty where there is none."""
    values = [row[key] for row in rows if row[key] is not None]
    if not values:
        return ""
    text = f"{statistics.median(values):.2f}{unit}"
    return text if len(values) == 1 else f"{text}\n{min(values):.2f} to {max(values):.2f}"


def _goal(part: str, rows: Sequence[Row]) -> str:
    row = rows[0]
    count = row[{"sweep": "workers", "search": "camera_rate", "analyse": "megabytes"}.get(part, "vehicles")]
    goal = GOALS.get((part, count, row.get("mode")))
    if goal is None:
        return ""
    return {"drawing": "{:g}", "analyse": "{:g}", "free": "{:.2f}"}.get(part, "{:g} x").format(goal)


def _range(key: str, unit: str = "") -> _Cell:
    return lambda _, rows: _with_range(key, rows, unit)


def _median(key: str, form: str, scale: float = 1.0) -> _Cell:
    def cell(_: str, rows: Sequence[Row]) -> str:
        return format(statistics.median(row[key] for row in rows) * scale, form)

    return cell


def _share(key: str) -> _Cell:
    return lambda _, rows: f"{statistics.median(row['cpu_share'][key] for row in rows):.0%}"


def _frame_cpu(*programs: str) -> _Cell:
    """Return the CPU time of a frame in some programs; without names, in all others."""

    def of(row: Row) -> float:
        use = row["cpu_per_frame"]
        return sum(use[name] for name in use if (name in programs if programs else name not in _DRAWERS))

    return lambda _, rows: f"{statistics.median(map(of, rows)):.1f}"


def _flown(_: str, rows: Sequence[Row]) -> str:
    return f"{statistics.median(row['flight']['simulated'] for row in rows):.1f}"


_DRAWERS = ("rviz_offscreen", "ffmpeg")
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
    "simplified": [*_SPEED, ("us/vehicle-turn", _median("microseconds_per_vehicle_turn", ".2f"))],
    "drawing": [
        ("vehicles", _vehicles),
        ("pictures/s", _range("pictures_per_second")),
        ("to\nreach", _goal),
    ],
    "sweep": [
        ("workers", _workers),
        ("runs/s", _range("runs_per_second")),
        ("with one\nworker", _range("one_worker")),
        ("speed-up", _range("speed_up", " x")),
        ("to\nreach", _goal),
    ],
    "detector": [
        ("input\npx", _input_size),
        ("ms/picture", _range("milliseconds")),
    ],
    "renderer": [
        ("picture", _label_only),
        ("CPU\nms/picture", _range("milliseconds")),
        ("wall\nms/picture", _range("wall_milliseconds")),
    ],
    "rviz": [
        ("film", _label_only),
        ("frames/s", _range("frames_per_second")),
        *((name, _frame_cpu(name)) for name in _DRAWERS),
        ("others", _frame_cpu()),
    ],
    "analyse": [
        ("bag", _label_only),
        ("reading\nMB/s", _range("megabytes_per_second")),
        ("to\nreach", _goal),
        ("CPU\ns", _range("cpu_seconds")),
        ("messages", _median("messages", ".0f")),
        ("memory\nMB", _median("memory_bytes", ".0f", 1e-6)),
        ("report\ns", _median("report_seconds", ".1f")),
    ],
    "barrier": [
        ("participants", _participants),
        ("median", _median("median_us", ".1f")),
        ("mean", _median("mean_us", ".1f")),
        ("p99", _median("p99_us", ".1f")),
        ("server\nCPU", _median("server_cpu_us", ".1f")),
        ("participants'\nCPU", _median("participants_cpu_us", ".1f")),
        ("ticks", _median("ticks", ".0f")),
    ],
    "stack": [*_SPEED, ("messages/s", _median("messages_per_second", ".0f")), *_PROCESSES],
    "formation": [*_SPEED, ("simulated\ns", _flown), *_PROCESSES],
    "search": [
        ("rate", _label_only),
        ("real-time\nfactor", _factor),
        ("to\nreach", _goal),
        *((name, _share(name)) for name in ("cameras", "yolo", "simulator", "mavros", "others")),
    ],
    "free": [
        ("vehicles", _vehicles),
        ("in lockstep", _range("exact_real_time_factor", " x")),
        ("free-running", _range("free_real_time_factor", " x")),
        ("share", _range("exact_share")),
        ("to\nreach", _goal),
    ],
}
