"""Figures of the processes of a soak, and the limits that they are held against."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from benchmarks.process_use import PROC

PROCESSES = ("simulator", "mavros", "rosmaster", "rosout")
FIGURES = ("rss", "anonymous", "descriptors", "threads", "sockets")
"""Figures of each process: memory in MiB, and counts. ``anonymous`` is the memory that no file backs."""
COLUMNS = (
    *("wall", "soak_time", "kind", "episode", "rtf", "cpu_per_second", "participants"),
    *(f"{process}_{figure}" for process in PROCESSES for figure in FIGURES),
)
"""Columns of ``samples.csv``, one line at the end of each episode, when nothing flies and no other node runs."""
_GROWTH = dict(zip(FIGURES, (2.0, 2.0, 0.5, 0.25, 0.5), strict=True))
_GROWTH_OF_ROS = dict(zip(FIGURES, (6.0, 6.0, 2.0, 1.0, 2.0), strict=True))
ALLOWED_GROWTH = {
    "participants": 0.1,
    **{f"{process}_{figure}": _GROWTH[figure] for process in PROCESSES[:2] for figure in FIGURES},
    **{f"{process}_{figure}": _GROWTH_OF_ROS[figure] for process in PROCESSES[2:] for figure in FIGURES},
}
"""Allowed growth per simulated hour, by column. ROS's own master and log keep some data of every node."""
ALLOWED_SLOWDOWN = 0.2
"""Fraction by which the processor time of a simulated second may grow from the first to the last quarter."""
LEAST_FLIGHTS = 0.9
"""Required fraction of the requested takeoffs."""
_WARM_UP, _WARM_UP_HOURS = 0.1, 0.5  # not judged: this fraction of the soak, at most these hours
_LEAST_SAMPLES = 8
_CONFIDENCE = 0.99


class Growth(NamedTuple):
    """Growth of a column: slope and its 99 % confidence interval, per simulated hour; NaN for too few samples."""

    slope: float
    low: float
    high: float


def process_figures(pid: int, proc: Path = PROC) -> dict[str, float]:
    """Return the figures of a process by name, see FIGURES.

    Raises:
        OSError: The process has ended.
    """
    folder = proc / str(pid)
    status = dict(line.split(":", 1) for line in (folder / "status").read_text(encoding="utf-8").splitlines())
    rollup = dict(line.split(":", 1) for line in (folder / "smaps_rollup").read_text(encoding="ascii").splitlines()[1:])
    links = []
    for entry in os.listdir(folder / "fd"):
        with suppress(OSError):  # closed in between
            links.append(os.readlink(folder / "fd" / entry))
    sockets = sum(link.startswith("socket:") for link in links)
    memory = int(status["VmRSS"].split()[0]) / 1024, int(rollup["Pss_Anon"].split()[0]) / 1024
    return dict(zip(FIGURES, (*memory, len(links), int(status["Threads"]), sockets), strict=True))


def growth(hours: Sequence[float], values: Sequence[float]) -> Growth:
    """Return Theil and Sen's slope of a series without its warm-up.

    Args:
        hours: Simulated times of the samples, h, ascending.
        values: Samples.
    """
    warm_up = min(_WARM_UP * hours[-1], _WARM_UP_HOURS) if len(hours) else 0.0
    kept = [(hour, value) for hour, value in zip(hours, values, strict=True) if hour >= warm_up]
    if len(kept) < _LEAST_SAMPLES:
        return Growth(np.nan, np.nan, np.nan)
    times, samples = np.array(kept, float).T
    fit = stats.theilslopes(samples, times, _CONFIDENCE)
    return Growth(float(fit.slope), float(fit.low_slope), float(fit.high_slope))


def growths(rows: Sequence[Mapping[str, Any]]) -> dict[str, Growth]:
    """Return the growth of every column with a limit."""
    found = {}
    for column in ALLOWED_GROWTH:
        known = [(row["soak_time"] / 3600.0, row[column]) for row in rows if row.get(column) is not None]
        found[column] = growth(*([list(part) for part in zip(*known, strict=True)] if known else ([], [])))
    return found


def slowdowns(rows: Sequence[Mapping[str, Any]]) -> dict[str, tuple[float, float]]:
    """Return the median processor time of a simulated second in the first and the last quarter, by kind of episode.

    Kinds with fewer than two episodes in either quarter are left out.
    """
    end = rows[-1]["soak_time"] if rows else 0.0
    found = {}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        first = [row["cpu_per_second"] for row in own if row["soak_time"] < 0.25 * end]
        last = [row["cpu_per_second"] for row in own if row["soak_time"] >= 0.75 * end]
        if min(len(first), len(last)) >= 2:
            found[kind] = float(np.median(first)), float(np.median(last))
    return found


def failures(rows: Sequence[Mapping[str, Any]], flights: int, expected: int, *, judge_growth: bool) -> list[str]:
    """Return a sentence for each limit that a soak has exceeded.

    Args:
        rows: Samples.
        flights: Number of vehicles that took off.
        expected: Number of vehicles that were commanded to.
        judge_growth: Whether growth and speed count; a short soak says nothing about them.
    """
    found = []
    if judge_growth:
        for column, (slope, low, _) in growths(rows).items():
            if slope > ALLOWED_GROWTH[column] and low > 0.0:
                found.append(f"{column} grows by {slope:.2f} an hour, {ALLOWED_GROWTH[column]:g} are allowed")
        for kind, (first, last) in slowdowns(rows).items():
            if last > (1.0 + ALLOWED_SLOWDOWN) * first:
                found.append(f"{kind} became slower: {first:.4f} to {last:.4f} processor seconds a simulated second")
    if flights < LEAST_FLIGHTS * expected:
        found.append(f"only {flights} of {expected} vehicles took off when commanded")
    return found
