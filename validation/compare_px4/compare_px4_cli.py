"""``./xtdrone compare-px4``: fly our autopilot through the recorded flights of a real PX4, and compare.

Exit status: 0 if every figure and event is within its tolerance, 1 if not, 2 for a value that is not
allowed.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from validation.compare_px4 import event_tolerances, flown_scripts, pictures, reference, response_tolerances
from validation.compare_px4.event_tolerances import Match
from validation.compare_px4.pilot import PilotError
from validation.compare_px4.response_tolerances import Figure
from xtdrone_common.files import write_whole
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError
from xtdrone_worlds.data_files import data_path
from xtdrone_worlds.descriptions import ModelError

_MARK = {True: "within", False: "OUTSIDE"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = "Fly our autopilot through the recorded flights of a real PX4, and compare."
    add = parser.add_argument
    add("--vehicle", default="px4_reference", metavar="TYPE",
        help="vehicle type; px4_reference is the plant of the recording (default: %(default)s)")  # fmt: skip
    add("--flights", nargs="+", choices=flown_scripts.FLIGHTS, default=list(flown_scripts.FLIGHTS), metavar="FLIGHT",
        help=f"flights to fly, of {', '.join(flown_scripts.FLIGHTS)} (default: all)")  # fmt: skip
    add("--seed", type=int, default=0, metavar="SEED", help="seed of all noise (default: %(default)s)")
    add("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/px4-<time>)")


def run(arguments: argparse.Namespace) -> int:
    """Fly, draw, print, and return the exit status."""
    try:
        command_options.one_of_files("vehicle type", arguments.vehicle, data_path("config/vehicles"))
        folder = command_options.new_folder(arguments.out or Path("runs") / time.strftime("px4-%Y%m%d-%H%M%S"))
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    flights = tuple(name for name in flown_scripts.FLIGHTS if name in arguments.flights)
    theirs = reference.load()
    try:
        ours = flown_scripts.fly(
            arguments.vehicle, flights, arguments.seed, lambda name: print(f"flying {name}", flush=True)
        )
    except (ModelError, PilotError, OSError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    figures = [figure for flight in flights for figure in response_tolerances.figures(theirs, ours, flight)]
    matches = [match for flight in flights for match in event_tolerances.compare(theirs, ours, flight)]
    folder.mkdir(parents=True, exist_ok=True)
    for flight in flights:
        pictures.save(theirs, ours, flight, folder)
    text = report(arguments.vehicle, figures, matches)
    write_whole(folder / "report.txt", text)
    print(text)
    print(f"pictures and tables: {folder}")
    return 1 if _outside(figures, matches) else 0


def _outside(figures: Sequence[Figure], matches: Sequence[Match]) -> int:
    return sum(not figure.within for figure in figures) + sum(not match.within for match in matches)


def report(vehicle: str, figures: Sequence[Figure], matches: Sequence[Match]) -> str:
    """Return the tables: figures, events, and how many are outside."""
    lines = [f"Vehicle {vehicle} beside a recorded PX4 v1.14.3", "", _figure_row(None)]
    lines += [_figure_row(figure) for figure in figures]
    lines += ["", "Events: s since the command, or since the event before that had to be flown to", _event_row(None)]
    lines += [_event_row(match) for match in matches]
    outside = _outside(figures, matches)
    lines += ["", f"{len(figures)} figures, {len(matches)} events, {outside} outside their tolerance", ""]
    return "\n".join(lines)


def _figure_row(figure: Figure | None) -> str:
    if figure is None:
        return f"{'flight':15} {'figure':28} {'unit':6} {'PX4':>8} {'ours':>8} {'diff':>8} {'allowed':>8}"
    allowed = "-" if math.isinf(figure.allowed) else f"{figure.allowed:.2f}"
    mark = "info" if math.isinf(figure.allowed) else _MARK[figure.within]
    return (
        f"{figure.flight:15} {figure.name:28} {figure.unit:6} {figure.reference:8.2f} {figure.ours:8.2f} "
        f"{figure.ours - figure.reference:+8.2f} {allowed:>8} {mark}"
    )


def _event_row(match: Match | None) -> str:
    if match is None:
        return f"{'flight':15} {'event':62} {'PX4':>15} {'ours':>7} {'diff':>7} {'allowed':>8}"
    theirs = "-" if match.reference is None else f"{match.reference:.2f}"
    if match.uncertain and match.reference is not None:
        theirs = f"{max(match.reference - match.uncertain, 0.0):.2f}..{theirs}"
    ours = "-" if match.ours is None else f"{match.ours:.2f}"
    difference = "-" if math.isinf(match.difference) else f"{match.difference:+.2f}"
    mark = match.reason or _MARK[match.within]
    return f"{match.flight:15} {match.what[:62]:62} {theirs:>15} {ours:>7} {difference:>7} {match.allowed:8.2f} {mark}"
