"""Wall time taken by map updates and plans; written to a separate file, because no topic may depend on it."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from xtdrone_common.files import write_whole


class Stopwatch:
    """Durations by kind."""

    def __init__(self) -> None:
        """Start without any."""
        self._seconds: dict[str, list[float]] = {}

    @contextmanager
    def measuring(self, kind: str) -> Iterator[None]:
        """Record the duration of the context under a kind."""
        begin = time.perf_counter()
        yield
        self._seconds.setdefault(kind, []).append(time.perf_counter() - begin)

    def summary(self) -> dict[str, dict[str, float]]:
        """Return, by kind, the number of durations, and their median, 95th percentile and maximum, ms."""
        return {kind: _summary(1000.0 * np.array(seconds)) for kind, seconds in self._seconds.items()}


def _summary(values: np.ndarray) -> dict[str, float]:
    return {
        "count": len(values),
        "median_ms": round(float(np.median(values)), 3),
        "p95_ms": round(float(np.percentile(values, 95)), 3),
        "most_ms": round(float(values.max()), 3),
    }


def write_summaries(path: Path, stopwatches: Mapping[str, Stopwatch]) -> None:
    """Write the summaries of some vehicles as JSON.

    Raises:
        OSError: the file cannot be written.
    """
    text = json.dumps({vehicle: watch.summary() for vehicle, watch in stopwatches.items()}, indent=2)
    write_whole(path, text + "\n")
