"""``./xtdrone replay-check``: the same flight under other conditions is the same flight, to the last bit.

Flies the formation flight with the same seed at other speeds, on one core, on a busy machine, with other processes, and
compares second by second the checksums of all published messages and of the true state of every vehicle. With
``--compare`` it compares the digest files of two flights that have been flown (launch argument ``digest``).

Exit status: 0 if all flights are the same, 1 for a difference or a failed flight, 2 for a value that is not allowed,
128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from validation.replay.digest_comparison import Comparison, DigestError, Digests, compare, read_digests
from xtdrone_common.files import write_whole
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.settings import Settings, setting
from xtdrone_coordination.patterns import PatternError
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError, patterns_setting, seed_setting, vehicles_setting
from xtdrone_interaction.console import PatientConsole
from xtdrone_interaction.launching.process_tree import ProcessTree
from xtdrone_interaction.launching.scripted_launch import (
    NODE_PATIENCE,
    PATIENCE,
    LaunchError,
    Stopped,
    StopRequest,
    cause,
    launch_command,
    launch_environment,
)
from xtdrone_interaction.recording.flight_events import read_events

TYPE = "iris"
_POLL = 0.2  # s of wall time between polls of signals and progress
_START_LIMIT = 120.0  # s of wall time until time starts
_SILENCE_LIMIT = 120.0  # s of wall time for one second of simulated time
_SPIN = "while True: pass"


@dataclass(frozen=True)
class Circumstance:
    """Conditions of a flight.

    Attributes:
        title: for the table.
        speed: target real-time factor, 0 for unlimited.
        one_core: whether all processes run on one core.
        load: number of busy programs beside it.
        processes: ``per_uav``, ``merged`` or ``shared``.
        recorded: whether rosbag, which is outside the lockstep, records it.
        truth_only: compare only the true states of the vehicles; otherwise all topics are published even without
            subscribers, so that subscribers make no difference.
    """

    title: str
    speed: float = 0.0
    one_core: bool = False
    load: int = 0
    processes: str = "per_uav"
    recorded: bool = False
    truth_only: bool = False


REFERENCE = Circumstance("as fast as it goes")
FULL = (
    Circumstance("once more"),
    Circumstance("real time", speed=1.0),
    Circumstance("half speed", speed=0.5),
    Circumstance("one core", one_core=True),
    Circumstance("busy machine", load=4),
    Circumstance("no subscribers", truth_only=True),
    Circumstance("recorded by rosbag", recorded=True, truth_only=True),
    Circumstance("a process per vehicle", processes="merged"),
    Circumstance("shared processes", processes="shared"),
)
SHORT = (
    Circumstance("a process per vehicle, half speed, one busy core", 0.5, one_core=True, load=2, processes="merged"),
    Circumstance("shared processes, real time", speed=1.0, processes="shared"),
    Circumstance("recorded by rosbag", recorded=True, truth_only=True),
)


@dataclass(frozen=True)
class ReplaySettings(Settings):
    """Flights to fly.

    Attributes:
        circumstances: each compared with the reference.
        folder: of logs and digests, absolute.
    """

    n: int = vehicles_setting(text="number of vehicles (with --short: 3)")
    patterns: tuple[str, ...] = patterns_setting()
    until: float = setting(
        0.0,
        low=0.0,
        unit="s",
        metavar="S",
        text="simulated time at which each flight ends, 0 for whole flights (with --short: 12)",
    )
    seed: int = seed_setting()
    circumstances: tuple[Circumstance, ...] = FULL
    folder: Path = Path()


@dataclass(frozen=True)
class Flight:
    """A completed flight.

    Attributes:
        circumstance: its conditions.
        digests: of the published messages.
        wall: time from the launch to the end, s.
        end_us: end of the comparison, simulated microseconds.
    """

    circumstance: Circumstance
    digests: Digests
    wall: float
    end_us: int


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly the same formation flight under other conditions (speed, cores, load, processes) and check that every "
        "node publishes the same messages, to the last bit."
    )
    add = parser.add_argument
    add(
        "--short",
        action="store_true",
        help="three vehicles, twelve simulated seconds, three conditions: about a minute",
    )
    ReplaySettings.add_arguments(parser, ("n", "patterns", "until", "seed"))
    add("--out", type=Path, metavar="FOLDER", help="new folder for logs and digests (default: runs/replay-<time>)")
    add("--compare", type=Path, nargs=2, metavar="FILE", help="fly nothing: compare two digest files, written by the "
        "launch argument digest:=FILE")  # fmt: skip


def replay_settings(arguments: argparse.Namespace) -> ReplaySettings:
    """Return the settings after checking them.

    Raises:
        OptionError, PatternError: a value is not allowed.
    """
    short = {"n": 3, "patterns": ("origin",), "until": 12.0, "circumstances": SHORT} if arguments.short else {}
    settings = ReplaySettings.from_arguments(
        arguments, **{name: value for name, value in short.items() if not hasattr(arguments, name)}
    )
    command_options.swarm_patterns(settings.n, settings.patterns)
    command_options.check_vehicle_ports(parse_fleet(f"{TYPE}:{settings.n}"))
    folder = command_options.new_folder(arguments.out or Path("runs") / f"replay-{time.strftime('%Y%m%d-%H%M%S')}")
    return replace(settings, folder=folder)


def run_check(settings: ReplaySettings, console: Console) -> int:
    """Fly, compare, print, and return the exit status."""
    console.print(f"Results: {settings.folder}", highlight=False, soft_wrap=True)
    with StopRequest() as stop:
        reference = fly(settings, REFERENCE, stop, console)
        console.print(_flight_line(reference), highlight=False, soft_wrap=True)
        rows: list[tuple[Flight, Comparison]] = []
        for circumstance in settings.circumstances:
            flight = fly(settings, circumstance, stop, console)
            known = reference.digests.truth() if circumstance.truth_only else reference.digests
            result = compare(known, flight.digests, min(reference.end_us, flight.end_us))
            if reference.end_us != flight.end_us and result.same:
                # Both flights have no time limit, so they must end at the same time.
                early = min(reference.end_us, flight.end_us) * 1e-6
                result = replace(result, difference_time=early, differing=("the flight's end",))
            rows.append((flight, result))
            console.print(f"{_flight_line(flight)}: {verdict(result)}", highlight=False, soft_wrap=True)
    _print_table(reference, rows, console)
    outcome = settings.folder / "replay.json"
    write_whole(outcome, json.dumps(outcome_data(settings, reference, rows), indent=2) + "\n")
    console.print(f"  {outcome}", highlight=False, soft_wrap=True)
    return 0 if all(result.same for _, result in rows) else 1


def compare_files(first: Path, second: Path, console: Console) -> int:
    """Compare the digest files of two flights up to the end of the shorter one; return the exit status.

    Raises:
        DigestError: a file is not a digest file.
    """
    known, other = read_digests(first), read_digests(second)
    result = compare(known, other, min(known.end, other.end))
    console.print(
        f"{result.topics} topics, {result.messages} messages, until {result.time:.3f} s: {verdict(result)}",
        highlight=False,
        soft_wrap=True,
    )
    return 0 if result.same else 1


def fly(settings: ReplaySettings, circumstance: Circumstance, stop: StopRequest, console: Console) -> Flight:
    """Fly once.

    Raises:
        LaunchError: the flight failed.
        Stopped: a signal was received.
    """
    folder = settings.folder / circumstance.title.replace(" ", "-").replace(",", "")
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    digest, log = folder / "digest.jsonl", folder / "logs" / "roslaunch.log"
    arguments: dict[str, object] = {
        "n": settings.n,
        "type": TYPE,
        "patterns": ",".join(settings.patterns),
        "processes": circumstance.processes,
        "speed": circumstance.speed,
        "seed": settings.seed,
        "until": settings.until,
        "digest": digest,
        "digest_topics": str(not circumstance.truth_only).lower(),
        "out": folder,
        "bag": folder / "flight.bag" if circumstance.recorded else "none",
    }
    port = command_options.free_port()
    command = launch_command("formation.launch", arguments, port)
    if circumstance.one_core:
        core = min(os.sched_getaffinity(0))
        command = ["taskset", "-c", str(core), *command]
    began = time.monotonic()
    with _busy(circumstance), _status(console, circumstance.title) as progress:
        tree = ProcessTree(command, launch_environment(port, folder / "logs"), log)
        try:
            _follow(tree, digest, log, stop, progress)
        finally:
            tree.stop(PATIENCE)
    wall = time.monotonic() - began
    try:
        digests = read_digests(digest)
    except DigestError as error:
        raise LaunchError(f"{circumstance.title}: {error}; {cause(log)}") from error
    return Flight(circumstance, digests, wall, _end_us(settings, folder, digests, log))


def _end_us(settings: ReplaySettings, folder: Path, digests: Digests, log: Path) -> int:
    """Return the end of the comparison, simulated us; messages published during the shutdown do not count."""
    if settings.until:
        end = round(settings.until * 1e6)
        if digests.end < end:
            raise LaunchError(f"{folder.name}: the flight ended at {digests.end * 1e-6:g} s; {cause(log)}")
        return end
    events = read_events(folder / "events.jsonl")
    if not events or events[-1]["event"] != "done":
        raise LaunchError(f"{folder.name}: the flight was not flown to its end; {cause(log)}")
    return round(events[-1]["time"] * 1e6)


def _follow(tree: ProcessTree, digest: Path, log: Path, stop: StopRequest, progress: Callable[[str], None]) -> None:
    """Wait until a flight has ended.

    Raises:
        LaunchError: simulated time does not advance.
        Stopped: a signal was received.
    """
    last, limit, simulated = time.monotonic(), _START_LIMIT, -1.0
    while not tree.wait(_POLL):
        stop.check()
        now = _simulated(digest)
        if now != simulated:
            simulated, last, limit = now, time.monotonic(), _SILENCE_LIMIT
            progress(f"{simulated:.0f} s simulated")
        if time.monotonic() - last > limit:
            raise LaunchError(f"{digest.parent.name}: nothing happened for {limit:.0f} s; {cause(log)}")


def _simulated(digest: Path) -> float:
    """Return the simulated time of the last complete line of a digest file, s; -1 before the first."""
    try:
        with digest.open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - (1 << 16)))
            lines = file.read().split(b"\n")
    except OSError:
        return -1.0
    return json.loads(lines[-2])["time"] * 1e-6 if len(lines) > 2 else -1.0


@contextmanager
def _busy(circumstance: Circumstance) -> Iterator[None]:
    """Keep the machine busy; only the core of the flight if that runs on one core."""
    prefix = ["taskset", "-c", str(min(os.sched_getaffinity(0)))] if circumstance.one_core else []
    command = [*prefix, sys.executable, "-c", _SPIN]
    trees = [ProcessTree(command, os.environ, Path(os.devnull)) for _ in range(circumstance.load)]
    try:
        yield
    finally:
        for tree in trees:
            tree.stop(NODE_PATIENCE)


@contextmanager
def _status(console: Console, title: str) -> Iterator[Callable[[str], None]]:
    """Show the progress of a flight: in place on a terminal, else only its start."""
    if not console.is_terminal:
        console.print(f"{title} ...", highlight=False, soft_wrap=True)
        yield lambda text: None
        return
    with console.status(title) as status:
        yield lambda text: status.update(f"{title}: {text}")


def _flight_line(flight: Flight) -> str:
    return f"{flight.circumstance.title}: {flight.end_us * 1e-6:.2f} s simulated in {flight.wall:.1f} s with start-up"


def verdict(result: Comparison) -> str:
    """Return the outcome of a comparison in words."""
    if result.same:
        return "the same to the last bit"
    if result.difference_time is None:
        return "nothing could be compared"
    names = ", ".join(result.differing[:6]) + (" ..." if len(result.differing) > 6 else "")
    return f"differs in the second before {result.difference_time:.3f} s: {names}"


def outcome_data(
    settings: ReplaySettings, reference: Flight, rows: Sequence[tuple[Flight, Comparison]]
) -> dict[str, Any]:
    """Return the outcome as data for JSON; times in s."""
    return {
        "same": all(result.same for _, result in rows),
        "vehicles": settings.n,
        "patterns": list(settings.patterns),
        "seed": settings.seed,
        "until": settings.until or None,
        "reference": {
            "circumstance": asdict(reference.circumstance),
            "sim_time": reference.end_us * 1e-6,
            "wall_time": reference.wall,
        },
        "flights": [
            {
                "circumstance": asdict(flight.circumstance),
                "sim_time": flight.end_us * 1e-6,
                "wall_time": flight.wall,
                "same": result.same,
                "verdict": verdict(result),
                "compared_time": result.time,
                "topics": result.topics,
                "messages": result.messages,
                "bytes": result.bytes,
                "difference_time": result.difference_time,
                "differing": list(result.differing),
            }
            for flight, result in rows
        ],
    }


def _print_table(reference: Flight, rows: Sequence[tuple[Flight, Comparison]], console: Console) -> None:
    """Print the outcome in at most 80 columns; the differing topics were printed with each flight."""
    title = "The same flight under other circumstances, compared with: " + reference.circumstance.title
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in ("circumstance", "wall\n(s)", "until\n(s)", "topics", "messages", "MB", "outcome"):
        left = heading in ("circumstance", "outcome")
        table.add_column(heading, justify="left" if left else "right", no_wrap=heading != "circumstance")
    for flight, result in rows:
        figures: list[Any] = [f"{flight.wall:.1f}", f"{result.time:.2f}", result.topics, result.messages]
        table.add_row(
            flight.circumstance.title,
            *map(str, figures),
            f"{result.bytes * 1e-6:.1f}",
            "[green]same[/green]" if result.same else "[red]differs[/red]",
        )
    console.print(table)


def run(arguments: argparse.Namespace) -> int:
    """Run the check and return its exit status."""
    if arguments.compare:
        try:
            first, second = arguments.compare
            return compare_files(first, second, PatientConsole())
        except DigestError as error:
            print(f"xtdrone: {error}", file=sys.stderr)
            return 2
    try:
        settings = replay_settings(arguments)
    except (OptionError, PatternError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    console = PatientConsole()
    try:
        return run_check(settings, console)
    except LaunchError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except Stopped as stopped:
        console.print(f"stopped by {stopped}; nothing is left running", highlight=False)
        return 128 + stopped.number
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
