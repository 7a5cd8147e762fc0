"""Launch arguments and figures of the benchmark's flights: the stack under one client, and the whole formation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.measurement_runner import TYPE, Bench, Event, Row, find
from benchmarks.process_use import CpuSample, memory, overlap, process_tree


def stack_arguments(bench: Bench, known: Row, folder: Path) -> dict[str, Any]:
    """Return the launch arguments of bench.launch."""
    return {"vehicles": f"{TYPE}:{known['vehicles']}", "window": bench.length.window}


def stack_figures(events: Sequence[Event], began: float) -> Row:
    """Return the figures of simulator and MAVROS layer under one client that holds every vehicle in OFFBOARD.

    Args:
        events: of the client.
        began: monotonic wall time of the start of roslaunch, s.

    Returns:
        real_time_factor, window (``simulated`` and ``elapsed`` s), messages_per_second (of wall time),
        messages_per_simulated_second (by topic), cpu_per_simulated_second (CPU s by program), overlap (share of all
        cores that the programs used), others_cpu (cores used by other programs), memory_bytes, processes,
        startup_seconds (from roslaunch to all armed).

    Raises:
        BenchError: an event is missing.
    """
    window = find(events, "window")
    simulated, elapsed = window["simulated"], window["elapsed"]
    received: dict[str, int] = window["received"]
    return {
        "real_time_factor": simulated / elapsed,
        "window": {"simulated": simulated, "elapsed": elapsed},
        "messages_per_second": sum(received.values()) / elapsed,
        "messages_per_simulated_second": {topic: count / simulated for topic, count in received.items()},
        "cpu_per_simulated_second": {name: seconds / simulated for name, seconds in window["cpu"].items()},
        "overlap": overlap(window["cpu"], elapsed),
        "others_cpu": window["others"] / elapsed,
        "memory_bytes": window["memory"],
        "processes": window["processes"],
        "startup_seconds": find(events, "armed")["wall"] - began,
    }


def formation_arguments(bench: Bench, known: Row, folder: Path) -> dict[str, Any]:
    """Return the launch arguments of formation.launch: the demo's flight, recorder included, at unlimited speed."""
    return {
        "n": known["vehicles"],
        "type": TYPE,
        "patterns": ",".join(bench.length.patterns),
        "processes": known["mode"],
        "speed": 0.0,
    }


def formation_figures(events: Sequence[Event], began: float) -> Row:
    """Return the figures of a formation flight that its director's events contain.

    Args:
        events: of the director.
        began: monotonic wall time of the start of roslaunch, s.

    Returns:
        real_time_factor (from armed to all disarmed), flight (``simulated`` and ``elapsed`` s), startup_seconds (from
        roslaunch to all armed), unsettled (phases that did not settle in time).

    Raises:
        BenchError: an event is missing.
    """
    armed, done = find(events, "armed"), find(events, "done")
    simulated, elapsed = done["time"] - armed["time"], done["wall"] - armed["wall"]
    return {
        "real_time_factor": simulated / elapsed,
        "flight": {"simulated": simulated, "elapsed": elapsed},
        "startup_seconds": armed["wall"] - began,
        "unsettled": done["unsettled"],
    }


@dataclass
class FormationProbe:
    """Samples the process tree during a flight: CPU from arming to landing, memory in the middle.

    Attributes:
        middle: pattern at whose beginning memory is sampled.
        samples: (event, CPU sample) at arming and at the beginning of the landing.
        memory: bytes; 0 before the sample.
        processes: their number at that time.
    """

    middle: str
    samples: list[tuple[Event, CpuSample]] = field(default_factory=list)
    memory: int = 0
    processes: int = 0

    def __call__(self, event: Event, root: int) -> None:
        """Make the samples due at ``event``; ``root`` is the tree's first process."""
        if event["event"] == "armed" or event.get("phase") == "land":
            self.samples.append((event, CpuSample.take(root)))
        if event.get("phase") == f"pattern {self.middle}" and not self.memory:
            pids = process_tree(root)
            self.memory, self.processes = memory(pids), len(pids)


def formation_probe(bench: Bench) -> FormationProbe:
    """Return the probe of a formation flight."""
    return FormationProbe(bench.length.patterns[len(bench.length.patterns) // 2])


def probe_figures(probe: FormationProbe) -> Row:
    """Return the figures sampled during a flight.

    Returns:
        cpu_per_simulated_second (CPU s by program, arming to landing), overlap (share of all cores that the programs
        used), others_cpu (cores used by other programs), memory_bytes and processes in mid-flight.
    """
    (first, before), (last, after) = probe.samples[0], probe.samples[-1]
    simulated, elapsed = last["time"] - first["time"], last["wall"] - first["wall"]
    use = after.since(before)
    return {
        "cpu_per_simulated_second": {name: seconds / simulated for name, seconds in use.programs.items()},
        "overlap": overlap(use.programs, elapsed),
        "others_cpu": use.others / elapsed,
        "memory_bytes": probe.memory,
        "processes": probe.processes,
    }
