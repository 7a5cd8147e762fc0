"""Runs per second of a sweep with several workers and with one: ``python -m benchmarks.programs.sweep``.

The time between completed runs is measured while all workers are busy, without their start and end.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

from benchmarks.programs.program_frame import Column, Row, run
from xtdrone_interaction.studies.dask_execution import Executor, local_client
from xtdrone_interaction.sweep.fly_one_run import fly_batch

_COMMON = {
    "engine": "simplified",
    "flight": "airborne",
    "constants": {"n": 9, "patterns": "cube,pyramid,triangle"},
    "sources": {},
}
_WARM = 8  # runs per worker before the measurement


class _EnoughError(Exception):
    """The measurement is long enough."""


def throughput(workers: int, seconds: float) -> float:
    """Return the runs per second of ``workers`` processes; a run is nine vehicles through three patterns.

    Args:
        workers: 1 or more.
        seconds: minimum wall time of the measurement.
    """
    times: list[tuple[float, int]] = []
    warm = 0

    def tasks() -> Iterator[dict[str, Any]]:
        return ({"key": str(seed), "seed": seed, "varied": {}} for seed in itertools.count())

    def deliver(rows: list[dict[str, Any]]) -> None:
        nonlocal warm
        failed = [row["error"] for row in rows if row["error"]]
        if failed:
            raise RuntimeError(f"a run failed: {failed[0]}")
        if warm < _WARM * workers:
            warm += len(rows)
            return
        times.append((time.monotonic(), len(rows)))
        if times[-1][0] - times[0][0] >= seconds:
            raise _EnoughError

    with local_client(workers) as client, suppress(_EnoughError):
        Executor(client, fly_batch, _COMMON).run(tasks(), deliver, lambda: None)
    # The first batch was flown before the first time; all others were flown between the times.
    return sum(count for _, count in times[1:]) / (times[-1][0] - times[0][0])


def measure(workers: int, seconds: float) -> dict[str, float]:
    """Return runs_per_second of ``workers`` processes, one_worker (the same of one) and speed_up, their ratio."""
    one = throughput(1, seconds)
    many = throughput(workers, seconds)
    return {"workers": workers, "one_worker": one, "runs_per_second": many, "speed_up": many / one}


COLUMNS = (
    Column("workers", "{workers}"),
    Column("runs/s", "{runs_per_second:.1f}"),
    Column("with one worker", "{one_worker:.1f}"),
    Column("speed-up", "{speed_up:.2f}x"),
)


def main() -> int:
    """Measure the number of workers of the command line and return the exit status."""
    parser = argparse.ArgumentParser(description="Throughput of a sweep with several workers and with one.")
    parser.add_argument("--workers", type=int, default=2, help="processes, at least 2")
    parser.add_argument("--seconds", type=float, default=20.0, help="minimum wall time of each measurement, s")
    return run(parser, _cases, COLUMNS)


def _cases(arguments: argparse.Namespace) -> Iterator[Row]:
    if arguments.workers < 2 or not arguments.seconds > 0.0:
        raise ValueError("workers: at least 2; seconds: above 0")
    yield measure(arguments.workers, arguments.seconds)


if __name__ == "__main__":
    sys.exit(main())
