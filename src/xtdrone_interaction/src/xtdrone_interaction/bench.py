"""``./xtdrone bench``: how fast this machine simulates, what it takes, and how long a flight takes to begin.

Thirteen parts: the core alone (no ROS), the simplified simulator (no ROS), its drawing, a sweep with several workers
against one, the detector of people, the cameras' renderer, films of rviz without a screen, the reading of a large bag,
the lockstep's barrier alone, the stack without the swarm's own nodes, the whole formation flight, the cooperative
search by the rate of its cameras, and the speed of the formation flight in lockstep compared with the same nodes
running free. Prints tables and writes JSON with the machine's facts; the JSON is written after each measurement, so
that nothing measured is lost. Exit status: 0, 1 when a measurement failed, 2 for a value that is not allowed, 128 + n
when stopped by signal n.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_control.fleet import MAX_VEHICLES, parse_fleet
from xtdrone_coordination.patterns import PatternError
from xtdrone_interaction import options
from xtdrone_interaction.bench_barrier import NOBODY, PROGRAMS
from xtdrone_interaction.bench_flight import (
    TYPE,
    Bench,
    Length,
    Row,
    measure_analysis,
    measure_barrier,
    measure_core,
    measure_detector,
    measure_drawing,
    measure_formation,
    measure_renderer,
    measure_rviz,
    measure_simplified,
    measure_stack,
    measure_sweep,
)
from xtdrone_interaction.bench_free import measure_free
from xtdrone_interaction.bench_machine import machine_facts
from xtdrone_interaction.bench_report import print_results, short_result
from xtdrone_interaction.bench_search import SEARCHERS, measure_search
from xtdrone_interaction.options import OptionError
from xtdrone_interaction.scripted_launch import LaunchError, Stopped, StopRequest

SCHEMA = 1  # of the JSON file
PARTS: dict[str, tuple[int, ...]] = {
    "core": (1, 9, 30, 100),
    "simplified": (9, 100, 1000),
    "drawing": (9, 100, 1000),
    "sweep": (2,),
    "detector": (320, 416, 640),
    "renderer": (320, 640),
    "rviz": (9, 30),
    "analyse": (1000,),
    "barrier": (0, 1, 9, 20, 60),
    "stack": (1, 9, 30),
    "formation": (9, 30),
    "search": (2, 5),
    "free": (9, 30),
}
_LEAST = {
    "core": 1,
    "simplified": 2,
    "drawing": 2,
    "sweep": 2,
    "detector": 32,
    "renderer": 16,
    "rviz": 1,
    "analyse": 1,
    "barrier": 0,
    "stack": 1,
    "formation": 2,
    "search": 1,
    "free": 2,
}
_MOST = {
    "simplified": 10_000,
    "drawing": 10_000,
    "sweep": 64,
    "detector": 2048,
    "renderer": 4096,
    "analyse": 20_000,
    "search": 10,
}  # of other parts MAX_VEHICLES
_COUNTED = {
    "barrier": "participants",
    "sweep": "workers",
    "detector": "widths",
    "renderer": "widths",
    "analyse": "megabytes",
    "search": "rates",
}  # of other parts vehicles
_OF_THEIR_OWN = ("sweep", "detector", "renderer", "analyse", "search")  # parts whose numbers are given by name only
_FLOWN = ("stack", "formation", "free")
_FILMS = ((1280, 720, True), (1280, 720, False), (640, 360, True))  # width and height in pixels, smooth edges
_MODES = {"both": ("per_uav", "shared"), "per-uav": ("per_uav",), "shared": ("shared",)}
_MAX_REPEATS = 20


FULL = Length(
    core_seconds=3.0,
    sweep_seconds=20.0,
    barrier_seconds=2.0,
    barrier_ticks=200,
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
    window=5.0,
    patterns=("cube",),
    free_window=2.0,
    search_window=10.0,
)


@dataclass(frozen=True)
class BenchSettings:
    """What is measured.

    Attributes:
        vehicles: numbers of vehicles (barrier: of participants; sweep: of workers; detector, renderer: pixels of
            width; analyse: MB of the bag; search: pictures a second of each camera) by part; parts that are not
            measured are left out.
        modes: of the formation: ``per_uav``, ``shared``.
        repeat: how often each measurement is made.
        length: of the measurements.
        json: file of the results, absolute.
    """

    vehicles: dict[str, tuple[int, ...]]
    modes: tuple[str, ...]
    repeat: int
    length: Length
    json: Path

    @property
    def logs(self) -> Path:
        """Folder of logs and events, beside the results."""
        return self.json.with_name(f"{self.json.stem}-logs")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="xtdrone bench",
        description="Measure speed, memory and start-up on this machine. Let it have no other work meanwhile.",
    )
    add = parser.add_argument
    add("--only", metavar="PARTS", help=f"parts to measure, with commas between, of {', '.join(PARTS)} (default: all)")
    add("--vehicles", nargs="+", metavar="[PART=]NUMBERS",
        help="numbers of vehicles (barrier: of participants; sweep: of workers; detector, renderer: pixels of width; "
        "analyse: MB of the bag; search: pictures a second of each camera), with commas between, for one part (as "
        "core=1,100) or for all but sweep, detector, renderer, analyse, search (as 9); default: "
        + " ".join(f"{part}={','.join(map(str, counts))}" for part, counts in PARTS.items()))  # fmt: skip
    add("--processes", choices=list(_MODES), default="both",
        help="formation with a process per vehicle and role, with one per role, or both (default)")  # fmt: skip
    add("--repeat", default="1", metavar="TIMES",
        help="make each measurement so often; tables show medians (default: 1)")  # fmt: skip
    add("--quick", action="store_true", help="short measurements: rough figures in a few minutes")
    add("--json", type=Path, metavar="FILE", help="file of the results (default: runs/bench-<time>.json)")
    return parser


def bench_settings(arguments: argparse.Namespace) -> BenchSettings:
    """Return the settings after all checks.

    Raises:
        OptionError, PatternError: a value that is not allowed.
    """
    vehicles = chosen_vehicles(chosen_parts(arguments.only), arguments.vehicles or [])
    length = QUICK if arguments.quick else FULL
    for count in {*vehicles.get("formation", ()), *vehicles.get("free", ())}:
        options.swarm_patterns(count, list(length.patterns))
    flown = max((count for part in _FLOWN for count in vehicles.get(part, ())), default=0)
    if "search" in vehicles:
        flown = max(flown, SEARCHERS)
    if flown:
        options.check_vehicle_ports(parse_fleet(f"{TYPE}:{flown}"))
    repeat = _whole_number("repeat", arguments.repeat, 1, _MAX_REPEATS)
    return BenchSettings(vehicles, _MODES[arguments.processes], repeat, length, _result_file(arguments.json))


def chosen_parts(text: str | None) -> list[str]:
    """Return the parts that are measured, in their usual order.

    Raises:
        OptionError: an unknown one.
    """
    if text is None:
        return list(PARTS)
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in PARTS:
            raise OptionError(f"only: part {name!r} is unknown; there are: {', '.join(PARTS)}")
    return [part for part in PARTS if part in names]


def chosen_vehicles(parts: Sequence[str], texts: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Return the numbers of vehicles by part.

    Args:
        parts: that are measured.
        texts: ``9``, ``1,9`` (all parts that count vehicles or participants) or ``core=1,9``; later ones count.

    Raises:
        OptionError: a number that is not allowed, or that is for no part which is measured.
    """
    chosen = {part: PARTS[part] for part in parts}
    for text in texts:
        name, equals, numbers = text.rpartition("=")
        if equals and name not in chosen:
            raise OptionError(f"vehicles: part {name!r} in {text!r} is not measured; measured are: {', '.join(chosen)}")
        meant = [name] if equals else [part for part in parts if part not in _OF_THEIR_OWN]
        if not meant:
            given = " and ".join(f"{_counted(part)} are given as {part}={text}" for part in parts)
            raise OptionError(f"vehicles: {text!r} is for no part that is measured; {given}")
        for part in meant:
            counts = (
                _whole_number(f"{_counted(part)} of {part}", n, _LEAST[part], _MOST.get(part, MAX_VEHICLES))
                for n in numbers.split(",")
            )
            chosen[part] = tuple(dict.fromkeys(counts))
    for width in chosen.get("detector", ()):
        if width % 32:
            raise OptionError(f"widths of detector: {width} is not allowed; multiples of 32")
    return chosen


def _counted(part: str) -> str:
    """Return what a part has numbers of."""
    return _COUNTED.get(part, "vehicles")


def _whole_number(thing: str, text: str, least: int, most: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = least - 1
    if not least <= value <= most:
        raise OptionError(f"{thing}: {text!r} is not allowed; {least} to {most}")
    return value


def _result_file(wanted: Path | None) -> Path:
    """Return the file of the results, absolute, after making its folder."""
    path = (wanted or Path("runs") / f"bench-{time.strftime('%Y%m%d-%H%M%S')}.json").resolve()
    if any(c.isspace() for c in str(path)):
        raise OptionError(f"json: {str(path)!r} has a space in it, which roslaunch cannot pass on; choose --json")
    if path.is_dir():
        raise OptionError(f"json: {str(path)!r} is a folder; a file is needed")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.open("a").close()
    except OSError as error:
        raise OptionError(f"json: {str(path)!r} cannot be written: {error.strerror}") from error
    return path


def plan(settings: BenchSettings) -> Iterator[tuple[str, str, Row, Callable[[Bench], Row]]]:
    """Yield (part, title, what a row always has, measurement) in the order in which they are made."""
    for part, counts in settings.vehicles.items():
        for count in counts:
            for title, known, measure in _variants(part, count, settings.modes):
                for number in range(1, settings.repeat + 1):
                    ending = f", {number} of {settings.repeat}" if settings.repeat > 1 else ""
                    yield part, f"{part}, {title}{ending}", known | {"repeat": number}, measure


def _variants(part: str, count: int, modes: Sequence[str]) -> Iterator[tuple[str, Row, Callable[[Bench], Row]]]:
    """Yield (title, what a row always has, measurement) of a part's measurements with ``count`` vehicles."""
    if part == "barrier":
        for kind in PROGRAMS if count else (NOBODY,):
            title = f"{count} participants" + (f", {kind}" if count else "")
            known: Row = {"participants": count, "kind": kind}
            yield title, known, partial(measure_barrier, participants=count, kind=kind)
        return
    if part == "sweep":
        yield f"{count} workers", {"workers": count}, partial(measure_sweep, workers=count)
        return
    if part == "detector":
        yield f"{count} px wide", {"width": count}, partial(measure_detector, width=count)
        return
    if part == "renderer":
        for height in (count * 9 // 16, count * 3 // 4):
            for backend in ("egl", "tiny"):
                known = {"width": count, "height": height, "backend": backend}
                measure = partial(measure_renderer, width=count, height=height, backend=backend)
                yield f"{count} x {height} px, {backend}", known, measure
        return
    if part == "rviz":
        for width, height, smooth in _FILMS:
            known = {"vehicles": count, "width": width, "height": height, "antialiasing": smooth}
            measure = partial(measure_rviz, vehicles=count, width=width, height=height, antialiasing=smooth)
            yield f"{count} vehicles, {width} x {height} px{'' if smooth else ', rough'}", known, measure
        return
    if part == "analyse":
        yield f"bag of {count} MB", {"megabytes": count}, partial(measure_analysis, megabytes=count)
        return
    if part == "search":
        known = {"vehicles": SEARCHERS, "camera_rate": count}
        yield f"{count} Hz", known, partial(measure_search, camera_rate=count)
        return
    title, known = f"{count} {'vehicle' if count == 1 else 'vehicles'}", {"vehicles": count}
    if part == "formation":
        for mode in modes:
            measure = partial(measure_formation, vehicles=count, processes=mode)
            yield f"{title}, processes {mode.replace('_', ' ')}", known | {"mode": mode}, measure
        return
    measurements = {
        "core": measure_core,
        "simplified": measure_simplified,
        "drawing": measure_drawing,
        "stack": measure_stack,
        "free": measure_free,
    }
    yield title, known, partial(measurements[part], vehicles=count)


def new_results(settings: BenchSettings) -> dict[str, Any]:
    """Return the results' frame: all but the rows."""
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
        "machine": machine_facts(options.repository()),
        **{part: [] for part in settings.vehicles},
    }


def run_bench(settings: BenchSettings, console: Console) -> int:
    """Measure, print, write, and return the exit status."""
    results = new_results(settings)
    _print_machine(results["machine"], console)
    status = 0
    try:
        with StopRequest() as stop:
            _measure_all(settings, results, stop, console)
        results["finished"] = time.strftime("%Y-%m-%dT%H:%M:%S%z")
    except Stopped as stopped:
        console.print(f"stopped by {stopped}; nothing is left running", highlight=False)
        status = 128 + stopped.number
    _write(results, settings.json)
    print_results(results, console)
    console.print(f"Results: {settings.json}", highlight=False, soft_wrap=True)
    failed = any("error" in row for part in settings.vehicles for row in results[part])
    return status or int(failed)


def _measure_all(settings: BenchSettings, results: dict[str, Any], stop: StopRequest, console: Console) -> None:
    """Make all measurements; one that fails leaves a row with ``error`` and the others go on.

    Raises:
        Stopped: a signal came.
    """
    measurements = list(plan(settings))
    for number, (part, title, known, measure) in enumerate(measurements, 1):
        stop.check()
        head = f"\\[{number}/{len(measurements)}] {title}"
        with _progress(console, head) as progress:
            bench = Bench(settings.logs, stop, progress, settings.length)
            try:
                row = known | measure(bench)
            except (LaunchError, OptionError) as error:  # OptionError: a port was taken meanwhile
                row = known | {"error": str(error)}
        console.print(f"{head}: {short_result(row)}", highlight=False, soft_wrap=True)
        results[part].append(row)
        _write(results, settings.json)


@contextmanager
def _progress(console: Console, head: str) -> Iterator[Callable[[str], None]]:
    """Show what a measurement does: in place on a terminal, else its beginning only."""
    if not console.is_terminal:
        console.print(f"{head} ...", highlight=False, soft_wrap=True)
        yield lambda text: None
        return
    with console.status(head) as status:
        yield lambda text: status.update(f"{head}: {text}")


def _print_machine(machine: dict[str, Any], console: Console) -> None:
    console.print(
        f"{machine['cpu'] or 'unknown processor'}, {machine['cores']} cores, "
        f"{machine['memory_bytes'] / 2**30:.0f} GiB, {machine['system'] or 'unknown system'}, "
        f"Linux {machine['kernel']}, Python {machine['python']}, load {machine['load_before'][0]:.1f}",
        highlight=False,
        soft_wrap=True,
    )


def _write(results: dict[str, Any], path: Path) -> None:
    """Replace the file at once, so that it is whole at any time."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    part.replace(path)


def main(argv: Sequence[str]) -> int:
    """Run the benchmark and return its exit status."""
    try:
        settings = bench_settings(_parser().parse_args(argv))
    except (OptionError, PatternError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    try:
        return run_bench(settings, Console())
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
