"""Cells of the benchmark's tables: one text for the rows of repeated measurements."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence

from benchmarks.measurement_runner import Row

Cell = Callable[[Sequence[Row]], str]
"""Function that returns the text of a cell from the rows of one case."""
Field = tuple[str, Cell]
"""Heading and cell."""

DRAWING_PROGRAMS = ("rviz_offscreen", "ffmpeg")


def median(key: str, form: str, scale: float = 1.0) -> Cell:
    """Return a cell with the median of a figure."""

    def cell(rows: Sequence[Row]) -> str:
        return format(statistics.median(row[key] for row in rows) * scale, form)

    return cell


def spread(key: str, unit: str = "") -> Cell:
    """Return a cell with the median of a figure, and its range below if there are several values; empty without any."""

    def cell(rows: Sequence[Row]) -> str:
        values = [row[key] for row in rows if row[key] is not None]
        if not values:
            return ""
        text = f"{statistics.median(values):.2f}{unit}"
        return text if len(values) == 1 else f"{text}\n{min(values):.2f} to {max(values):.2f}"

    return cell


def goal(goals: dict[tuple[object, ...], float], keys: Sequence[str], form: str) -> Cell:
    """Return a cell with the goal of a case, empty for a case without one.

    Args:
        goals: by the values of ``keys``.
        keys: of a row.
        form: format string of the goal.
    """

    def cell(rows: Sequence[Row]) -> str:
        value = goals.get(tuple(rows[0][key] for key in keys))
        return "" if value is None else form.format(value)

    return cell


def share(program: str) -> Cell:
    """Return a cell with a program's share of the CPU time."""
    return lambda rows: f"{statistics.median(row['cpu_share'][program] for row in rows):.0%}"


def frame_cpu(*programs: str) -> Cell:
    """Return a cell with the CPU time of a frame in some programs, or, without any, in all but the drawing ones."""

    def of(row: Row) -> float:
        use = row["cpu_per_frame"]
        return sum(use[name] for name in use if (name in programs if programs else name not in DRAWING_PROGRAMS))

    return lambda rows: f"{statistics.median(map(of, rows)):.1f}"


def flight_time(rows: Sequence[Row]) -> str:
    """Return the median simulated time of flights, s."""
    return f"{statistics.median(row['flight']['simulated'] for row in rows):.1f}"


def input_size(rows: Sequence[Row]) -> str:
    """Return the size of a network's input, px; only the width before the measurement."""
    return " x ".join(str(rows[0][side]) for side in ("width", "height") if side in rows[0])
