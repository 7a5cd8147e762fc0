"""The benchmark's measurements: each runs a program or a launch file to its end and returns a row of figures.

A row has ``vehicles``, ``load_before`` (the machine's load average over the last minute) and the figures that
:func:`measure_core`, :func:`measure_simplified`, :func:`measure_drawing`, :func:`measure_sweep`, :func:`measure_rviz`,
:func:`measure_barrier`, :func:`measure_stack` and :func:`measure_formation` list. In place of ``vehicles`` a row of the
barrier has ``participants`` and ``kind``, one of the sweep ``workers``.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from xtdrone_control.fleet import parse_fleet
from xtdrone_interaction import options
from xtdrone_interaction.bench_processes import CpuSample, memory, process_tree
from xtdrone_interaction.processes import ProcessTree
from xtdrone_interaction.record import read_events
from xtdrone_interaction.scripted_launch import (
    NODE_PATIENCE,
    PATIENCE,
    LaunchError,
    StopRequest,
    cause,
    launch_command,
    launch_environment,
    log_text,
)

TYPE = "iris"
Event = dict[str, Any]
Row = dict[str, Any]

_POLL = 0.1  # s of wall time
_START_LIMIT = 60.0  # s of wall time until the first event, and _START_LIMIT_VEHICLE more for each vehicle
_START_LIMIT_VEHICLE = 3.0
_SILENCE_LIMIT = 300.0  # s of wall time between two events; a phase may take a minute of simulated time


class BenchError(LaunchError):
    """A measurement that failed; the message says which part and where its log is."""


@dataclass(frozen=True)
class Length:
    """How long the measurements are.

    Attributes:
        core_seconds: least wall time of one core, simplified, drawing, detector, renderer or rviz measurement, s.
        sweep_seconds: least wall time of a sweep's measurement with one worker, and of that with all, s.
        barrier_seconds: least wall time of one barrier measurement, s.
        barrier_ticks: least number of ticks of one barrier measurement.
        window: measured simulated time of the stack, s.
        patterns: that the formation flies.
        free_window: wall time for which each speed of the free-running flight is measured, s.
        search_window: measured simulated time of the search, s.
    """

    core_seconds: float
    sweep_seconds: float
    barrier_seconds: float
    barrier_ticks: int
    window: float
    patterns: tuple[str, ...]
    free_window: float
    search_window: float


@dataclass
class Bench:
    """What all measurements share.

    Attributes:
        folder: of logs and events, absolute; each measurement has its own in it.
        stop: asked all the time.
        progress: gets a few words on what goes on.
        length: of the measurements.
    """

    folder: Path
    stop: StopRequest
    progress: Callable[[str], None]
    length: Length


def measure_core(bench: Bench, vehicles: int) -> Row:
    """Measure the core alone: physics, contacts, sensors, estimators and control, without ROS.

    Returns:
        real_time_factor, vehicle_steps_per_second, microseconds_per_vehicle_step.

    Raises:
        BenchError: it failed.
    """
    row = _row(vehicles)
    arguments = ["--vehicles", str(vehicles), "--seconds", str(bench.length.core_seconds)]
    return row | _run_program(bench, "core", f"core-{vehicles}", "xtdrone_sim.benchmark", arguments)[0]


def measure_simplified(bench: Bench, vehicles: int) -> Row:
    """Measure the simplified simulator: vehicles, leader, followers with consensus and avoidance, on one core, no ROS.

    Returns:
        real_time_factor, microseconds_per_vehicle_turn.

    Raises:
        BenchError: it failed.
    """
    row = _row(vehicles)
    arguments = ["--vehicles", str(vehicles), "--seconds", str(bench.length.core_seconds)]
    module = "xtdrone_swarm.benchmark"
    return row | _run_program(bench, "simplified", f"simplified-{vehicles}", module, arguments)[0]


def measure_drawing(bench: Bench, vehicles: int) -> Row:
    """Measure the drawing of a swarm off-screen, with trails, topology and slots.

    Returns:
        pictures_per_second.

    Raises:
        BenchError: it failed.
    """
    row = _row(vehicles)
    arguments = ["--vehicles", str(vehicles), "--seconds", str(bench.length.core_seconds)]
    module = "xtdrone_swarm.view.benchmark"
    return row | _run_program(bench, "drawing", f"drawing-{vehicles}", module, arguments)[0]


def measure_sweep(bench: Bench, workers: int) -> Row:
    """Measure how many runs a second a sweep flies with ``workers`` processes, and with one.

    Returns:
        workers, one_worker and runs_per_second (runs a second with one and with all), speed_up (their ratio).

    Raises:
        BenchError: it failed.
    """
    row = {"load_before": os.getloadavg()[0]}
    arguments = ["--workers", str(workers), "--seconds", str(bench.length.sweep_seconds)]
    return row | _run_program(bench, "sweep", f"sweep-{workers}", "xtdrone_interaction.sweep.benchmark", arguments)


def measure_detector(bench: Bench, width: int) -> Row:
    """Measure the detector of people on one core.

    Args:
        bench: what all measurements share.
        width: of the network's input, pixels, a multiple of 32.

    Returns:
        width and height of the network's input, milliseconds a picture.

    Raises:
        BenchError: it failed.
    """
    row = {"load_before": os.getloadavg()[0]}
    arguments = ["--width", str(width), "--seconds", str(bench.length.core_seconds)]
    return row | _run_program(bench, "detector", f"detector-{width}", "xtdrone_perception.benchmark", arguments)[0]


def measure_renderer(bench: Bench, width: int, height: int, backend: str) -> Row:
    """Measure the drawing of what cameras see.

    Args:
        bench: what all measurements share.
        width, height: of the picture, pixels.
        backend: ``egl`` or ``tiny``.

    Returns:
        milliseconds a picture, of processor time and of wall time.

    Raises:
        BenchError: it failed, or there is no such renderer here.
    """
    row = {"load_before": os.getloadavg()[0]}
    arguments = ["--width", str(width), "--height", str(height), "--backend", backend]
    arguments += ["--seconds", str(bench.length.core_seconds)]
    name = f"renderer-{width}x{height}-{backend}"
    return row | _run_program(bench, "renderer", name, "xtdrone_sim.cameras.rendering.benchmark", arguments)[0]


def measure_rviz(bench: Bench, vehicles: int, width: int, height: int, antialiasing: bool) -> Row:
    """Measure the making of a film of rviz without a screen, from the bag's messages to the file.

    Args:
        bench: what all measurements share.
        vehicles: how many the view of the formation shows.
        width, height: of a frame, pixels.
        antialiasing: whether edges are smoothed.

    Returns:
        See :func:`xtdrone_interaction.rviz.benchmark.measure`.

    Raises:
        BenchError: it failed, or a program that it needs is not there.
    """
    row = {"load_before": os.getloadavg()[0]}
    arguments = ["--vehicles", str(vehicles), "--width", str(width), "--height", str(height)]
    arguments += ["--seconds", str(bench.length.core_seconds)] + ([] if antialiasing else ["--rough"])
    name = f"rviz-{vehicles}-{width}x{height}{'' if antialiasing else '-rough'}"
    return row | _run_program(bench, "rviz", name, "xtdrone_interaction.rviz.benchmark", arguments)


def measure_analysis(bench: Bench, megabytes: int) -> Row:
    """Measure the reading of a large bag and its report.

    Args:
        bench: what all measurements share.
        megabytes: of the bag, which is made for it and removed.

    Returns:
        megabytes, messages, seconds, cpu_seconds, megabytes_per_second (of the reading), memory_bytes (the process's
        most), report_seconds (with pictures and page).

    Raises:
        BenchError: it failed.
    """
    row = {"load_before": os.getloadavg()[0]}
    name = f"analyse-{megabytes}"
    folder = fresh_folder(bench, name)
    arguments = ["--megabytes", str(megabytes), "--folder", str(folder)]
    return row | _run_program(bench, "analyse", name, "xtdrone_interaction.analysis.benchmark", arguments)


def measure_barrier(bench: Bench, participants: int, kind: str) -> Row:
    """Measure the lockstep's barrier with participants that do nothing, all due at every tick.

    Args:
        bench: what all measurements share.
        participants: how many.
        kind: ``python``, ``cpp``, or ``none`` without participants.

    Returns:
        See :func:`xtdrone_interaction.bench_barrier.measure`.

    Raises:
        BenchError: it failed.
    """
    row = {"load_before": os.getloadavg()[0]}
    length = bench.length
    arguments = ["--participants", str(participants), "--kind", kind]
    arguments += ["--seconds", str(length.barrier_seconds), "--ticks", str(length.barrier_ticks)]
    name = f"barrier-{participants}-{kind}"
    return row | _run_program(bench, "barrier", name, "xtdrone_interaction.bench_barrier", arguments)


def _run_program(bench: Bench, part: str, name: str, module: str, arguments: Sequence[str]) -> Any:
    """Run a Python program that writes its result as JSON, and return that.

    Args:
        bench: what all measurements share.
        part: for the messages.
        name: of the measurement's folder.
        module: the program.
        arguments: besides ``--json``.

    Raises:
        BenchError: it failed.
    """
    folder = fresh_folder(bench, name)
    result, log = folder / "result.json", folder / "output.log"
    command = [sys.executable, "-m", module, *arguments, "--json", str(result)]
    tree = ProcessTree(command, os.environ, log)
    try:
        bench.progress("measuring")
        while not tree.wait(_POLL):
            bench.stop.check()
    finally:
        tree.stop(NODE_PATIENCE)
    if tree.process.returncode != 0 or not result.is_file():
        raise BenchError(f"{part}: ended with status {tree.status}; {cause(log)}")
    return json.loads(result.read_text(encoding="utf-8"))


def measure_stack(bench: Bench, vehicles: int) -> Row:
    """Measure simulator and MAVROS layer under one client that holds every vehicle in OFFBOARD.

    Returns:
        real_time_factor, window (``simulated`` and ``elapsed`` s), messages_per_second (of wall time),
        messages_per_simulated_second (by topic), cpu_per_simulated_second (CPU s by program), others_cpu (cores' worth
        that other programs took), memory_bytes, processes, startup_seconds (from roslaunch to all armed).

    Raises:
        BenchError: it failed.
    """
    folder = fresh_folder(bench, f"stack-{vehicles}")
    row, command_wall = _row(vehicles), time.time()
    arguments = {"vehicles": f"{TYPE}:{vehicles}", "window": bench.length.window, "out": folder}
    events = fly(bench, "bench.launch", arguments, folder, vehicles, lambda event, root: None)
    return row | stack_figures(events, command_wall)


def stack_figures(events: Sequence[Event], command_wall: float) -> Row:
    """Return the figures of a stack measurement from the client's events; see :func:`measure_stack`."""
    window = find(events, "window")
    simulated, elapsed = window["simulated"], window["elapsed"]
    received: dict[str, int] = window["received"]
    return {
        "real_time_factor": simulated / elapsed,
        "window": {"simulated": simulated, "elapsed": elapsed},
        "messages_per_second": sum(received.values()) / elapsed,
        "messages_per_simulated_second": {topic: count / simulated for topic, count in received.items()},
        "cpu_per_simulated_second": {name: seconds / simulated for name, seconds in window["cpu"].items()},
        "others_cpu": window["others"] / elapsed,
        "memory_bytes": window["memory"],
        "processes": window["processes"],
        "startup_seconds": find(events, "armed")["wall"] - command_wall,
    }


@dataclass
class FormationProbe:
    """Samples the process tree as the flight goes on: CPU from arming to landing, memory in the middle.

    Attributes:
        middle: pattern at whose beginning memory is sampled.
        samples: (event, CPU sample) at arming and at the beginning of the landing.
        memory: bytes; 0 before the sample.
        processes: how many there were then.
    """

    middle: str
    samples: list[tuple[Event, CpuSample]] = field(default_factory=list)
    memory: int = 0
    processes: int = 0

    def __call__(self, event: Event, root: int) -> None:
        """Take the samples that belong to ``event``; ``root`` is the tree's first process."""
        if event["event"] == "armed" or event.get("phase") == "land":
            self.samples.append((event, CpuSample.take(root)))
        if event.get("phase") == f"pattern {self.middle}" and not self.memory:
            pids = process_tree(root)
            self.memory, self.processes = memory(pids), len(pids)


def measure_formation(bench: Bench, vehicles: int, processes: str) -> Row:
    """Measure the whole formation flight as the demo flies it, recorder included, as fast as it goes.

    Args:
        bench: what all measurements share.
        vehicles: how many.
        processes: ``per_uav`` or ``shared``.

    Returns:
        mode (``processes``), real_time_factor (from armed to all disarmed), flight (``simulated`` and ``elapsed`` s),
        startup_seconds (from roslaunch to all armed), unsettled (phases that did not settle in time),
        cpu_per_simulated_second (CPU s by program, arming to landing), others_cpu (cores' worth that other programs
        took), memory_bytes and processes in mid-flight.

    Raises:
        BenchError: it failed.
    """
    folder = fresh_folder(bench, f"formation-{vehicles}-{processes}")
    row, command_wall = _row(vehicles) | {"mode": processes}, time.time()
    arguments = {
        "n": vehicles,
        "type": TYPE,
        "patterns": ",".join(bench.length.patterns),
        "processes": processes,
        "speed": 0.0,
        "out": folder,
    }
    probe = FormationProbe(bench.length.patterns[len(bench.length.patterns) // 2])
    try:
        events = fly(bench, "formation.launch", arguments, folder, vehicles, probe)
    finally:
        for bag in folder.glob("flight.bag*"):
            bag.unlink()  # large, and of no use here
    return row | formation_figures(events, command_wall) | probe_figures(probe)


def formation_figures(events: Sequence[Event], command_wall: float) -> Row:
    """Return the figures that stand in the director's events; see :func:`measure_formation`."""
    armed, done = find(events, "armed"), find(events, "done")
    simulated, elapsed = done["time"] - armed["time"], done["wall"] - armed["wall"]
    return {
        "real_time_factor": simulated / elapsed,
        "flight": {"simulated": simulated, "elapsed": elapsed},
        "startup_seconds": armed["wall"] - command_wall,
        "unsettled": done["unsettled"],
    }


def probe_figures(probe: FormationProbe) -> Row:
    """Return what was sampled during a flight; see :func:`measure_formation`."""
    (first, before), (last, after) = probe.samples[0], probe.samples[-1]
    simulated, elapsed = last["time"] - first["time"], last["wall"] - first["wall"]
    use = after.since(before)
    return {
        "cpu_per_simulated_second": {name: seconds / simulated for name, seconds in use.programs.items()},
        "others_cpu": use.others / elapsed,
        "memory_bytes": probe.memory,
        "processes": probe.processes,
    }


def find(events: Sequence[Event], name: str) -> Event:
    """Return the first event of that name.

    Raises:
        BenchError: there is none.
    """
    for event in events:
        if event["event"] == name:
            return event
    raise BenchError(f"events: there is no {name!r} among {', '.join(e['event'] for e in events) or 'none'}")


def _row(vehicles: int) -> Row:
    return {"vehicles": vehicles, "load_before": os.getloadavg()[0]}


def fresh_folder(bench: Bench, name: str) -> Path:
    """Return a measurement's folder without what an earlier one left."""
    folder = bench.folder / name
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    for file in ("events.jsonl", "result.json"):
        (folder / file).unlink(missing_ok=True)
    return folder


def fly(
    bench: Bench,
    launch_file: str,
    arguments: dict[str, Any],
    folder: Path,
    vehicles: int,
    on_event: Callable[[Event, int], None],
) -> list[Event]:
    """Run a launch file to its end and return the events of its director or client.

    Args:
        bench: what all measurements share.
        launch_file: its name in launch/.
        arguments: of the launch file.
        folder: where it writes events.jsonl, and its logs.
        vehicles: how many.
        on_event: called with each event as it comes and with roslaunch's process id.

    Raises:
        BenchError: it failed.
        OptionError: a UDP port that the vehicles need is taken.
    """
    options.check_vehicle_ports(parse_fleet(f"{TYPE}:{vehicles}"))
    log = folder / "logs" / "roslaunch.log"
    port = options.free_port()
    command = launch_command(launch_file, arguments, port)
    tree = ProcessTree(command, launch_environment(port, folder / "logs"), log)
    try:
        bench.progress("starting the nodes")
        return _follow(bench, tree, folder / "events.jsonl", log, vehicles, on_event)
    finally:
        tree.stop(PATIENCE)


def _follow(
    bench: Bench, tree: ProcessTree, file: Path, log: Path, vehicles: int, on_event: Callable[[Event, int], None]
) -> list[Event]:
    """Pass events on until the last has come, and give roslaunch the time to end by itself."""
    limit, last = _START_LIMIT + _START_LIMIT_VEHICLE * vehicles, time.monotonic()
    seen = 0
    while True:
        ended = tree.wait(_POLL)  # asked first: events that come before the end are read below
        bench.stop.check()
        events = read_events(file)
        for event in events[seen:]:
            on_event(event, tree.pid)
            bench.progress(_words(event))
            limit, last = _SILENCE_LIMIT, time.monotonic()
        seen = len(events)
        if seen and events[-1]["event"] == "failed":
            raise BenchError(f"{events[-1]['reason']}; log: {log}")
        if seen and events[-1]["event"] == "done":
            tree.wait(PATIENCE)
            return events
        if ended:
            raise BenchError(f"{log.parent.parent.name}: the launch ended early; {cause(log)}")
        if not seen and "has died" in log_text(log):
            raise BenchError(f"{log.parent.parent.name}: a node died at the start; {cause(log)}")
        if time.monotonic() - last > limit:
            raise BenchError(f"{log.parent.parent.name}: nothing happened for {limit:.0f} s; {cause(log)}")


def _words(event: Event) -> str:
    return f"{event.get('phase') or event['event']}, {event['time']:.0f} s simulated"
