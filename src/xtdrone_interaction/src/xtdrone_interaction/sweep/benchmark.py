"""How many runs a second a sweep flies with several workers, and with one: ``python -m ...sweep.benchmark``.

Measured is the time between two runs that come back while all workers are busy, so neither their start nor their end
counts.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from xtdrone_interaction.sweep.execute import Executor, local_client
from xtdrone_interaction.sweep.run import fly_batch

_COMMON = {
    "engine": "simplified",
    "flight": "airborne",
    "constants": {"n": 9, "patterns": "cube,pyramid,triangle"},
    "sources": {},
}
_WARM = 8  # runs a worker before the measurement


class _EnoughError(Exception):
    """The measurement is long enough."""


def throughput(workers: int, seconds: float) -> float:
    """Return the runs a second that ``workers`` processes fly; a run is nine vehicles through three patterns.

    Args:
        workers: 1 or more.
        seconds: least wall time of the measurement.
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
    # The first batch was flown before its time; what came after it was flown in between.
    return sum(count for _, count in times[1:]) / (times[-1][0] - times[0][0])


def measure(workers: int, seconds: float) -> dict[str, float]:
    """Return runs_per_second of ``workers`` processes, one_worker (the same of one) and speed_up, their ratio."""
    one = throughput(1, seconds)
    many = throughput(workers, seconds)
    return {"workers": workers, "one_worker": one, "runs_per_second": many, "speed_up": many / one}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Throughput of a sweep with several workers against one.")
    parser.add_argument("--workers", type=int, default=2, help="processes, at least 2")
    parser.add_argument("--seconds", type=float, default=20.0, help="least wall time of each measurement, s")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    if arguments.workers < 2 or not arguments.seconds > 0.0:
        parser.error("workers: at least 2; seconds: above 0")
    result = measure(arguments.workers, arguments.seconds)
    print(
        f"{result['one_worker']:.1f} runs/s with one worker, {result['runs_per_second']:.1f} with {arguments.workers}: "
        f"{result['speed_up']:.2f} x"
    )
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
