"""Instant flights, for tests of the sweep's machinery; importable in worker processes."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def figures(varied: Mapping[str, Any], seed: int) -> dict[str, Any]:
    """Return synthetic figures that depend on parameters and seed alone."""
    value = sum(float(v) for v in varied.values() if isinstance(v, int | float)) + 0.1 * seed
    return {"settled": True, "settling_time": value, "least_distance": 1.0 / (1.0 + value), "collisions": 0}


def work(common: Mapping[str, Any], tasks: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Replace ``fly_batch``; ``common`` may hold ``seconds`` per run, ``folder``, and ``deadly``, a seed."""
    rows = []
    for task in tasks:
        if "folder" in common:
            Path(common["folder"], f"{task['key']}-{os.getpid()}").touch()
        time.sleep(common.get("seconds", 0.0))
        if task["seed"] == common.get("deadly"):
            os.kill(os.getpid(), signal.SIGKILL)
        row = {"key": task["key"], "seed": task["seed"], **task["varied"], "error": None}
        rows.append(row | figures(task["varied"], task["seed"]) | {"wall_time": common.get("seconds", 1e-3)})
    return rows
