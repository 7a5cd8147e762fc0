"""``./xtdrone bench``: measure speed, memory and start-up on this machine.

The parts are those of :data:`benchmarks.measurement_table.MEASUREMENTS`. The command prints tables and writes JSON with
the facts of the machine; the JSON is rewritten after each measurement, so that an interruption loses nothing. Exit
status: 0, 1 when a measurement failed, 2 for a value that is not allowed, 128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from benchmarks.calibration import calibrate
from benchmarks.compare_with_commit import Request, Tree, measured_rows, prepare, print_comparison, resolve, turns
from benchmarks.flights.search_flights import SEARCHERS
from benchmarks.measurement_runner import TYPE, Bench, Case, Length
from benchmarks.measurement_table import MEASUREMENTS
from benchmarks.progress_and_files import print_machine, progress, write_results
from benchmarks.tables.printed_tables import print_results, short_result
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.settings import Settings, setting
from xtdrone_coordination.patterns import PatternError
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.launching.scripted_launch import LaunchError, Stopped, StopRequest
from xtdrone_interaction.machine_facts import machine_facts

SCHEMA = 1  # of the JSON file
_FLOWN = ("stack", "sensing", "formation", "free", "web")
_FORMATIONS = ("formation", "free", "web")
_MODES = {
    "all": ("per_uav", "merged", "shared"),
    "per-uav": ("per_uav",),
    "merged": ("merged",),
    "shared": ("shared",),
}

FULL = Length(
    core_seconds=3.0,
    sweep_seconds=20.0,
    barrier_seconds=2.0,
    barrier_ticks=200,
    telemetry_seconds=10.0,
    window=20.0,
    patterns=("cube", "pyramid", "triangle"),
    free_window=5.0,
    search_window=30.0,
)
QUICK = Length(
    core_seconds=1.0,
    sweep_seconds=3.0,
    barrier_seconds=0.5,
    barrier_ticks=50,
    telemetry_seconds=2.0,
    window=5.0,
    patterns=("cube",),
    free_window=2.0,
    search_window=10.0,
)


@dataclass(frozen=True, kw_only=True)
class BenchSettings(Settings):
    """Selected measurements.

    Attributes:
        vehicles: numbers of vehicles (barrier: participants; sweep: workers; rays: lidars; odometry: rings; detector,
            renderer: width in pixels; analyse: size of the bag in MB; search: images per second of each camera) by
            part.
        json: file of the results, absolute.
        baseline: this tree and the commit to compare it with, empty without a comparison.
    """

    vehicles: dict[str, tuple[int, ...]]
    json: Path
    processes: str = setting(
        "all",
        choices=tuple(_MODES),
        text="formation with a process per vehicle and role, with one per vehicle, with one per role, or all three",
    )
    repeat: int = setting(
        1, low=1, high=20, metavar="TIMES", text="repetitions of each measurement, of which the tables show medians"
    )
    quick: bool = setting(False, text="short measurements: rough figures in a few minutes")
    baseline: tuple[Tree, ...] = ()

    @property
    def modes(self) -> tuple[str, ...]:
        """Modes of the formation: ``per_uav``, ``merged``, ``shared``."""
        return _MODES[self.processes]

    @property
    def length(self) -> Length:
        """Length of the measurements."""
        return QUICK if self.quick else FULL

    @property
    def logs(self) -> Path:
        """Folder of logs and events beside the results."""
        return self.json.with_name(f"{self.json.stem}-logs")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Measure speed, memory and start-up on this machine. Run nothing else on the machine at the same time."
    )
    parts = ", ".join(MEASUREMENTS)
    numbers = " ".join(f"{m.name}={','.join(map(str, m.numbers))}" for m in MEASUREMENTS.values())
    own = ", ".join(m.name for m in MEASUREMENTS.values() if not m.counts_vehicles)
    add = parser.add_argument
    add("--only", metavar="PARTS", help=f"parts to measure, separated by commas, of {parts} (default: all)")
    add("--vehicles", nargs="+", metavar="[PART=]NUMBERS",
        help="numbers of vehicles (barrier: participants; sweep: workers; rays: lidars; odometry: rings; detector, "
        "renderer: width in pixels; analyse: size of the bag in MB; search: images per second of each camera), "
        f"separated by commas, for one part (as core=1,100) or for all parts but {own} (as 9); "
        f"default: {numbers}")  # fmt: skip
    BenchSettings.add_arguments(parser)
    add("--baseline", metavar="COMMIT",
        help="compare this tree with another commit: check it out and set it up beside this one, measure both "
        "alternately and print the ratio of each figure; --repeat 3 or more gives the spread")  # fmt: skip
    add("--json", type=Path, metavar="FILE", help="file of the results (default: runs/bench-<time>.json)")


def bench_settings(arguments: argparse.Namespace) -> BenchSettings:
    """Return the settings after checking them.

    Raises:
        OptionError, PatternError: a value is not allowed.
    """
    vehicles = chosen_vehicles(chosen_parts(arguments.only), arguments.vehicles or [])
    trees = resolve(arguments.baseline) if arguments.baseline is not None else ()
    settings = BenchSettings.from_arguments(
        arguments, vehicles=vehicles, json=_result_file(arguments.json), baseline=trees
    )
    for count in {count for part in _FORMATIONS for count in vehicles.get(part, ())}:
        command_options.swarm_patterns(count, list(settings.length.patterns))
    flown = max((count for part in _FLOWN for count in vehicles.get(part, ())), default=0)
    if "search" in vehicles:
        flown = max(flown, SEARCHERS)
    if flown:
        command_options.check_vehicle_ports(parse_fleet(f"{TYPE}:{flown}"))
    return settings


def chosen_parts(text: str | None) -> list[str]:
    """Return the parts to measure, in their usual order.

    Raises:
        OptionError: a part is unknown.
    """
    if text is None:
        return list(MEASUREMENTS)
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in MEASUREMENTS:
            raise OptionError(f"only: part {name!r} is unknown; there are: {', '.join(MEASUREMENTS)}")
    return [part for part in MEASUREMENTS if part in names]


def chosen_vehicles(parts: Sequence[str], texts: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Return the numbers of vehicles by part.

    Args:
        parts: to measure.
        texts: ``9``, ``1,9`` (all parts that count vehicles or participants) or ``core=1,9``; later ones take
            precedence.

    Raises:
        OptionError: a number is not allowed, or applies to no selected part.
    """
    chosen = {part: MEASUREMENTS[part].numbers for part in parts}
    for text in texts:
        name, equals, numbers = text.rpartition("=")
        if equals and name not in chosen:
            raise OptionError(f"vehicles: part {name!r} in {text!r} is not measured; measured are: {', '.join(chosen)}")
        meant = [name] if equals else [part for part in parts if MEASUREMENTS[part].counts_vehicles]
        if not meant:
            given = " and ".join(f"{MEASUREMENTS[part].counted} are given as {part}={text}" for part in parts)
            raise OptionError(f"vehicles: {text!r} is for no part that is measured; {given}")
        for part in meant:
            thing, limits = f"{MEASUREMENTS[part].counted} of {part}", MEASUREMENTS[part].limits
            counts = [_whole_number(thing, number, *limits) for number in numbers.split(",")]
            chosen[part] = tuple(dict.fromkeys(counts))
    for part in chosen:
        _check_multiples(part, chosen[part])
    return chosen


def _check_multiples(part: str, counts: Sequence[int]) -> None:
    measurement = MEASUREMENTS[part]
    for count in counts:
        if count % measurement.multiple_of:
            allowed = f"multiples of {measurement.multiple_of}"
            raise OptionError(f"{measurement.counted} of {part}: {count} is not allowed; {allowed}")


def _whole_number(thing: str, text: str, least: int, most: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value <= most:
        raise OptionError(f"{thing}: {text!r} is not allowed; {least} to {most}")
    return value


def _result_file(wanted: Path | None) -> Path:
    """Return the absolute path of the results, after making its folder."""
    path = (wanted or Path("runs") / f"bench-{time.strftime('%Y%m%d-%H%M%S')}.json").resolve()
    if any(c.isspace() for c in str(path)):
        raise OptionError(
            f"json: {str(path)!r} contains a space, which roslaunch does not support; choose another --json"
        )
    if path.is_dir():
        raise OptionError(f"json: {str(path)!r} is a folder; a file is needed")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("a").close()
    except OSError as error:
        raise OptionError(f"json: {str(path)!r} cannot be written: {error.strerror}") from error
    return path


def plan(settings: BenchSettings) -> Iterator[tuple[Case, int]]:
    """Yield each case with its title for the terminal, and the number of the repetition, in the order measured."""
    for part, counts in settings.vehicles.items():
        for count in counts:
            for case in MEASUREMENTS[part].cases(part, count, settings.modes):
                for number in range(1, settings.repeat + 1):
                    ending = f", {number} of {settings.repeat}" if settings.repeat > 1 else ""
                    yield replace(case, title=f"{part}, {case.title}{ending}"), number


def new_results(settings: BenchSettings) -> dict[str, Any]:
    """Return the results without any rows."""
    length = settings.length
    return {
        "schema": SCHEMA,
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "finished": None,
        "options": {
            "vehicles": {part: list(counts) for part, counts in settings.vehicles.items()},
            "type": TYPE,
            "repeat": settings.repeat,
            **asdict(length),
        },
        "machine": machine_facts(command_options.repository()),
        "calibration": calibrate(),
        **({"rows": {}} if settings.baseline else {part: [] for part in settings.vehicles}),
    }


def run_bench(settings: BenchSettings, console: Console) -> int:
    """Measure, print, write, and return the exit status."""
    if settings.baseline:
        return run_comparison(settings, console)
    results = new_results(settings)
    print_machine(results, console)
    status = 0
    try:
        with StopRequest() as stop:
            _measure_all(settings, results, stop, console)
        results["finished"] = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    except Stopped as stopped:
        console.print(f"stopped by {stopped}; nothing is left running", highlight=False)
        status = 128 + stopped.number
    write_results(results, settings.json)
    print_results(results, console)
    console.print(f"Results: {settings.json}", highlight=False, soft_wrap=True)
    failed = any("error" in row for part in settings.vehicles for row in results[part])
    return status or int(failed)


def run_comparison(settings: BenchSettings, console: Console) -> int:
    """Measure this tree and its baseline alternately, print, write, and return the exit status."""
    results = new_results(settings)
    results["trees"] = {tree.name: str(tree) for tree in settings.baseline}
    print_machine(results, console)
    console.print(f"this tree: {settings.baseline[1]}; baseline: {settings.baseline[0]}", highlight=False)
    status = 0
    try:
        with StopRequest() as stop:
            _compare_all(settings, results, stop, console)
        results["finished"] = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    except Stopped as stopped:
        console.print(f"stopped by {stopped}; nothing is left running", highlight=False)
        status = 128 + stopped.number
    except LaunchError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    write_results(results, settings.json)
    print_comparison(results, console)
    console.print(f"Results: {settings.json}", highlight=False, soft_wrap=True)
    return status or int(any("error" in row for rows in results["rows"].values() for row in rows))


def _compare_all(settings: BenchSettings, results: dict[str, Any], stop: StopRequest, console: Console) -> None:
    """Prepare the baseline and measure case by case; a failed one leaves a row with ``error``.

    Raises:
        Stopped: a signal was received.
        LaunchError: the baseline cannot be prepared.
    """
    with progress(console, "baseline") as show:
        baseline, this = settings.baseline
        prepare(baseline, this, Bench(settings.logs, stop, show, settings.length))
    more = ("--processes", settings.processes, *["--quick"] * settings.quick)
    for part, counts in settings.vehicles.items():
        for request in (Request(part, count, more) for count in counts):
            for number, tree in enumerate(turns(settings.baseline, settings.repeat)):
                stop.check()
                head = f"{part}, {request.number}, {tree.name}, {number // 2 + 1} of {settings.repeat}"
                with progress(console, head) as show:
                    rows = measured_rows(tree, request, Bench(settings.logs, stop, show, settings.length))
                results["rows"].setdefault(part, []).extend(rows)
                write_results(results, settings.json)


def _measure_all(settings: BenchSettings, results: dict[str, Any], stop: StopRequest, console: Console) -> None:
    """Make all measurements; a failed one leaves a row with ``error`` and the next one follows.

    Raises:
        Stopped: a signal was received.
    """
    cases = list(plan(settings))
    for number, (case, repetition) in enumerate(cases, 1):
        stop.check()
        head = f"\\[{number}/{len(cases)}] {case.title}"
        row = case.known | {"repeat": repetition}
        with progress(console, head) as show:
            bench = Bench(settings.logs, stop, show, settings.length)
            try:
                row |= MEASUREMENTS[case.part].command(bench, case)
            except (LaunchError, OptionError) as error:  # OptionError: a port has been taken in the meantime
                row["error"] = str(error)
        console.print(f"{head}: {short_result(case.part, row)}", highlight=False, soft_wrap=True)
        results[case.part].append(row)
        write_results(results, settings.json)


def run(arguments: argparse.Namespace) -> int:
    """Run the benchmark and return its exit status."""
    try:
        settings = bench_settings(arguments)
    except (OptionError, PatternError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    try:
        return run_bench(settings, Console())
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
