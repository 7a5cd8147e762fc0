"""Comparison of the formation flight in lockstep with the same nodes running free on /clock."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from benchmarks.measurement_runner import TYPE, Bench, BenchError, Case, Event, Row, find, fly, fresh_folder
from benchmarks.nodes.free_running_speeds import Trial, best, next_speed

_FLIGHTS = 4  # maximum of free-running flights: far too high a speed aborts a flight
_ROUNDS = 20  # of the patterns, so that a flight is longer than its measurement


def measure_free(bench: Bench, case: Case) -> Row:
    """Measure how fast the formation flight is in lockstep, and how fast its nodes can follow without it.

    A process per UAV, recorder included, in the climb and the pattern flights. Free-running, the simulator accepts any
    speed; the result is the highest one at which the nodes complete nearly all their cycles; see
    ``free_running_speeds``.

    Returns:
        load_before, and the figures of :func:`free_figures`.

    Raises:
        BenchError: it failed.
    """
    vehicles = case.known["vehicles"]
    row = {"load_before": os.getloadavg()[0]}
    exact = find(_measured(bench, vehicles, "exact", {}), "window")
    trials: list[Trial] = []
    for number in range(1, _FLIGHTS + 1):
        if next_speed(exact["real_time_factor"], trials) is None:
            break
        plan = {"exact": exact, "trials": [asdict(trial) for trial in trials]}
        trials += new_trials(_measured(bench, vehicles, f"free-{number}", plan))
    return row | free_figures(exact, trials)


def free_figures(exact: Event, trials: Sequence[Trial]) -> Row:
    """Return the figures of a comparison.

    Returns:
        exact_real_time_factor, free_real_time_factor (0 if no speed was good), exact_share (their ratio; None without),
        rates (messages per simulated s by role, in lockstep), trials (``free_running_speeds.Trial``, with ``good``),
        exact_cpu and free_cpu (CPU s per simulated s by program, the latter at the best speed), others_cpu (cores used
        by other programs, maximum of the flight in lockstep and the best speed).
    """
    top = best(trials)
    return {
        "exact_real_time_factor": exact["real_time_factor"],
        "free_real_time_factor": top.real_time_factor if top else 0.0,
        "exact_share": exact["real_time_factor"] / top.real_time_factor if top else None,
        "rates": exact["rates"],
        "trials": [asdict(trial) | {"good": trial.good} for trial in trials],
        "exact_cpu": exact["cpu"],
        "free_cpu": dict(top.cpu) if top else {},
        "others_cpu": max(exact["others_cpu"], top.others_cpu if top else 0.0),
    }


def new_trials(events: Sequence[Event]) -> list[Trial]:
    """Return the trials of a free-running flight, including the one during which the flight was aborted.

    Raises:
        BenchError: the flight ended before the first.
    """
    found = []
    trying: float | None = None
    for event in events:
        if event["event"] == "trying":
            trying = event["speed"]
        elif event["event"] == "trial":
            found.append(Trial(**{name: event[name] for name in Trial.__dataclass_fields__}))
            trying = None
    if trying is not None:
        found.append(Trial(trying))
    if not found:
        raise BenchError("free: the flight ended before a speed was tried")
    return found


def _measured(bench: Bench, vehicles: int, name: str, plan: dict[str, Any]) -> list[Event]:
    """Fly once according to the plan and return the probe's events.

    Raises:
        BenchError: it failed for another reason than too high a speed.
    """
    folder = fresh_folder(bench, f"free-{vehicles}-{name}")
    file = folder / "plan.json"
    file.write_text(json.dumps(plan | {"window": bench.length.free_window}), encoding="utf-8")
    arguments = {
        "n": vehicles,
        "type": TYPE,
        "patterns": ",".join(bench.length.patterns * _ROUNDS),
        "lockstep": str(not plan).lower(),
        "plan": file,
        "out": folder,
    }
    events: list[Event] = []
    try:
        fly(bench, "bench_free.launch", arguments, folder, vehicles, lambda event, root: events.append(event))
    except BenchError:
        if not any(event["event"] == "trying" for event in events):
            raise
    return events
