"""Cost of the browser station for the formation flight, with and without browsers, alternately in one flight."""

from __future__ import annotations

import json
import os
import statistics
from collections.abc import Sequence

from benchmarks.measurement_runner import TYPE, Bench, BenchError, Case, Event, Row, fly, fresh_folder

CLIENTS = 3
_ROUNDS = 3  # windows of either kind
_PATTERNS = 20  # rounds of the patterns, so that a flight is longer than its measurement


def measure_web(bench: Bench, case: Case) -> Row:
    """Measure a formation flight at unlimited speed, with the station and three clients that read its frames.

    The clients are programs that receive what browsers do and draw nothing.

    Returns:
        load_before, and the figures of :func:`web_figures`.

    Raises:
        BenchError: it failed.
    """
    vehicles = case.known["vehicles"]
    row = {"load_before": os.getloadavg()[0]}
    folder = fresh_folder(bench, case.folder)
    (folder / "flight").mkdir(exist_ok=True)  # the recorder may begin before the director makes it
    file = folder / "plan.json"
    plan = {"window": bench.length.free_window, "clients": CLIENTS, "rounds": _ROUNDS}
    file.write_text(json.dumps(plan), encoding="utf-8")
    arguments = {
        "n": vehicles,
        "type": TYPE,
        "patterns": ",".join(bench.length.patterns * _PATTERNS),
        "plan": file,
        "out": folder,
    }
    events = fly(bench, "bench_web.launch", arguments, folder, vehicles, lambda event, root: None)
    return row | web_figures(events)


def web_figures(events: Sequence[Event]) -> Row:
    """Return the figures of a flight's windows.

    Returns:
        real_time_factor (with clients), alone (without), kept (their ratio), station_cores (CPU s of the station per s
        of wall time with clients), station_cpu (CPU s per simulated s), idle_cores (without clients), cost (CPU time
        of station and flight with clients more than that of the flight without, as a share of the latter, per
        simulated s), readers_cores (CPU s of the clients, which a user's browser on another machine does not take
        here, per s), frame_rate (frames a client received, Hz of wall time), frame_bytes, others_cpu (cores used by
        other programs, greatest).

    Raises:
        BenchError: there is no window of either kind.
    """
    windows = [event for event in events if event["event"] == "window"]
    served = [window for window in windows if window["clients"]]
    alone = [window for window in windows if not window["clients"]]
    received = [event for event in events if event["event"] == "received" and event["frames"]]
    if not (served and alone and received):
        raise BenchError(f"web: {len(served)} windows with clients, {len(alone)} without, {len(received)} with frames")
    factor, without = (statistics.median(w["real_time_factor"] for w in group) for group in (served, alone))
    return {
        "real_time_factor": factor,
        "alone": without,
        "kept": factor / without,
        "station_cores": _total(served, "station") / _total(served, "elapsed"),
        "station_cpu": _rate(served, "station"),
        "cost": (_rate(served, "station") + _rate(served, "flight")) / _rate(alone, "flight") - 1.0,
        "readers_cores": _total(served, "readers") / _total(served, "elapsed"),
        "idle_cores": _total(alone, "station") / _total(alone, "elapsed"),
        "frame_rate": statistics.median(event["frames"] / event["clients"] / event["elapsed"] for event in received),
        "frame_bytes": _total(received, "bytes") / _total(received, "frames"),
        "others_cpu": max(window["others_cpu"] for window in windows),
    }


def _rate(windows: Sequence[Event], name: str) -> float:
    """Return CPU s per simulated s."""
    return _total(windows, name) / _total(windows, "simulated")


def _total(events: Sequence[Event], name: str) -> float:
    return float(sum(event[name] for event in events))
