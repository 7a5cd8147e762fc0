"""Runs the program or the launch file of a measurement to its end."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction import command_options
from xtdrone_interaction.launching.process_tree import ProcessTree
from xtdrone_interaction.launching.scripted_launch import (
    NODE_PATIENCE,
    PATIENCE,
    LaunchError,
    StopRequest,
    cause,
    launch_command,
    launch_environment,
    log_text,
)
from xtdrone_interaction.recording.flight_events import read_events

TYPE = "iris"
Event = dict[str, Any]
Row = dict[str, Any]
Observer = Callable[[Event, int], None]
"""Called with each event of a flight, and with roslaunch's process id."""

_POLL = 0.1  # s of wall time
_START_LIMIT = 60.0  # s of wall time until the first event, and _START_LIMIT_VEHICLE more for each vehicle
_START_LIMIT_VEHICLE = 3.0
_SILENCE_LIMIT = 300.0  # s of wall time between two events; a phase may take a minute of simulated time


class BenchError(LaunchError):
    """A measurement that failed; the message names the part and its log."""


@dataclass(frozen=True)
class Length:
    """Lengths of the measurements.

    Attributes:
        core_seconds: minimum wall time of one core, simplified, drawing, detector, renderer, rays, effects, planning,
            odometry or rviz measurement, s.
        sweep_seconds: minimum wall time of a sweep's measurement with one worker, and of that with all workers, s.
        barrier_seconds: minimum wall time of one barrier measurement, s.
        barrier_ticks: minimum number of ticks of one barrier measurement.
        telemetry_seconds: simulated time of one telemetry measurement, s.
        window: measured simulated time of the stack, with and without sensors, s.
        patterns: flown by the formation.
        free_window: wall time for which each speed of the free-running flight, and the station with or without
            clients, is measured, s.
        search_window: measured simulated time of the search, s.
    """

    core_seconds: float
    sweep_seconds: float
    barrier_seconds: float
    barrier_ticks: int
    telemetry_seconds: float
    window: float
    patterns: tuple[str, ...]
    free_window: float
    search_window: float


@dataclass
class Bench:
    """Shared by all measurements.

    Attributes:
        folder: of logs and events, absolute; each measurement has a folder of its own in it.
        stop: polled during each measurement.
        progress: shows a few words about the state of the measurement.
        length: of the measurements.
    """

    folder: Path
    stop: StopRequest
    progress: Callable[[str], None]
    length: Length


@dataclass(frozen=True)
class Case:
    """One case of a measurement.

    Attributes:
        part: name of the measurement, as ``renderer``.
        title: for the terminal, as ``320 x 240 px, egl``.
        known: fields of the result that are known before the measurement, as its number of vehicles.
        suffix: distinguishes the case's folder from those of the other cases, as ``320x240-egl``.
    """

    part: str
    title: str
    known: Row
    suffix: str

    @property
    def folder(self) -> str:
        """Name of the folder of its logs."""
        return f"{self.part}-{self.suffix}"


@dataclass(frozen=True)
class Program:
    """A program of ``benchmarks/programs``; the known fields of a case are its options.

    Attributes:
        name: of its module.
        lengths: further options, with the field of :class:`Length` that has the value.
    """

    name: str
    lengths: Mapping[str, str] = field(default_factory=dict)

    def __call__(self, bench: Bench, case: Case) -> Row:
        """Measure a case and return its figures.

        Raises:
            BenchError: the program failed.
        """
        load = os.getloadavg()[0]
        words = [word for name, value in case.known.items() for word in _option(name, value)]
        words += [
            word for name, source in self.lengths.items() for word in _option(name, getattr(bench.length, source))
        ]
        rows = run_program(bench, case.part, case.folder, f"benchmarks.programs.{self.name}", words)
        return {"load_before": load} | rows[0]


def _option(name: str, value: object) -> list[str]:
    if isinstance(value, bool):
        return [f"--{name}" if value else f"--no-{name}"]
    return [f"--{name}", str(value)]


@dataclass(frozen=True)
class Flight:
    """A launch file that ends when its director or probe is done; the figures come from the events of that node.

    Attributes:
        launch_file: its name in launch/.
        arguments: launch arguments of a case; called with the case's folder as well. ``out`` is added.
        figures: computes the figures from the events and the wall time of the start, epoch s.
        observer: called with each event during the flight; makes the observer of one flight.
        observed: computes further figures from that observer.
    """

    launch_file: str
    arguments: Callable[[Bench, Row, Path], dict[str, Any]]
    figures: Callable[[Sequence[Event], float], Row]
    observer: Callable[[Bench], Any] = lambda bench: lambda event, root: None
    observed: Callable[[Any], Row] = lambda observer: {}

    def __call__(self, bench: Bench, case: Case) -> Row:
        """Fly a case and return its figures.

        Raises:
            BenchError: the flight failed.
            OptionError: a UDP port that the vehicles need is taken.
        """
        folder = fresh_folder(bench, case.folder)
        row, began = {"load_before": os.getloadavg()[0]}, time.monotonic()
        arguments = {**self.arguments(bench, case.known, folder), "out": folder}
        observer = self.observer(bench)
        events = fly(bench, self.launch_file, arguments, folder, case.known["vehicles"], observer)
        return row | self.figures(events, began) | self.observed(observer)


def run_program(bench: Bench, part: str, name: str, module: str, arguments: Sequence[str]) -> Any:
    """Run a Python program that writes its result as JSON, and return the result.

    Args:
        bench: shared by all measurements.
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
    tree = ProcessTree(command, _environment(os.environ), log)
    try:
        bench.progress("measuring")
        while not tree.wait(_POLL):
            bench.stop.check()
    finally:
        tree.stop(NODE_PATIENCE)
    if tree.process.returncode != 0 or not result.is_file():
        raise BenchError(f"{part}: ended with status {tree.status}; {cause(log)}")
    return json.loads(result.read_text(encoding="utf-8"))


def _environment(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a Python program that imports this package."""
    path = os.pathsep.join(filter(None, [environment.get("PYTHONPATH"), str(command_options.repository())]))
    return {**environment, "PYTHONPATH": path}


def find(events: Sequence[Event], name: str) -> Event:
    """Return the first event of that name.

    Raises:
        BenchError: there is none.
    """
    for event in events:
        if event["event"] == name:
            return event
    raise BenchError(f"events: there is no {name!r} among {', '.join(e['event'] for e in events) or 'none'}")


def fresh_folder(bench: Bench, name: str) -> Path:
    """Return the folder of a measurement, cleared of the results of an earlier one."""
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
    on_event: Observer,
) -> list[Event]:
    """Run a launch file to its end, remove its bags, and return the events of its director or probe.

    Args:
        bench: shared by all measurements.
        launch_file: its name in launch/.
        arguments: of the launch file.
        folder: of events.jsonl and the logs.
        vehicles: number of vehicles, which need UDP ports.
        on_event: called with each event when it is read.

    Raises:
        BenchError: it failed.
        OptionError: a UDP port that the vehicles need is taken.
    """
    command_options.check_vehicle_ports(parse_fleet(f"{TYPE}:{vehicles}"))
    log = folder / "logs" / "roslaunch.log"
    port = command_options.free_port()
    command = launch_command(launch_file, arguments, port)
    tree = ProcessTree(command, launch_environment(port, folder / "logs"), log)
    try:
        bench.progress("starting the nodes")
        return _follow(bench, tree, folder / "events.jsonl", log, vehicles, on_event)
    finally:
        tree.stop(PATIENCE)
        for bag in folder.rglob("flight.bag*"):
            bag.unlink()  # large, and not needed


def _follow(bench: Bench, tree: ProcessTree, file: Path, log: Path, vehicles: int, on_event: Observer) -> list[Event]:
    """Report events until the last one, then give roslaunch time to end."""
    limit, last = _START_LIMIT + _START_LIMIT_VEHICLE * vehicles, time.monotonic()
    seen = 0
    while True:
        ended = tree.wait(_POLL)  # before the events are read, so that none is missed
        bench.stop.check()
        events = read_events(file)
        for event in events[seen:]:
            on_event(event, tree.pid)
            bench.progress(_describe(event))
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


def _describe(event: Event) -> str:
    return f"{event.get('phase') or event['event']}, {event['time']:.0f} s simulated"
