"""``./xtdrone compare A B ...``: two or more runs, or a run and a reference, on the same axes.

Exit status: 0 when a report was written, 1 when a run cannot be read, 2 for an invalid value.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from xtdrone_interaction import command_options
from xtdrone_interaction.bags.ros1bag import BagError
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.metrics.comparison import ALIGNMENTS, CompareError, aligned, compare, matched, read_run
from xtdrone_interaction.missions.formation.report import find_formation
from xtdrone_interaction.recording.flight_from_ulog import LogError
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.compare import compare_page, pictures
from xtdrone_interaction.report.html_page import print_page, write_page

_MOST_RUNS = 12
_LONG_NAME = 20  # letters


def names_of(files: Sequence[Path], names: str | None) -> list[str]:
    """Return a name for each run: those given, else the shortest end of its path that is unique.

    Of long ends only the first part is kept: those of flight logs end in the same date and file name.

    Raises:
        OptionError: another number of names, or one twice.
    """
    if names is not None:
        given = [name.strip() for name in names.split(",")]
        if len(given) != len(files) or len(set(given)) != len(files) or not all(given):
            raise OptionError(f"names: {names!r} is not allowed; {len(files)} different comma-separated names")
        return given
    paths = [file.resolve() for file in files]
    for length in range(1, max(len(path.parts) for path in paths) + 1):
        found = ["/".join(path.parts[-length:]) for path in paths]
        if len(set(found)) == len(found):
            alone = [path.parts[-length] for path in paths]
            return alone if max(map(len, found)) > _LONG_NAME and len(set(alone)) == len(alone) else found
    return [f"{number}: {path.name}" for number, path in enumerate(paths, 1)]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Draw runs on the same axes and compute their distance from the first: report.html, pictures, "
        "report.json. Runs are bags, ULogs, flight.npz, or tables (.csv: time, x, y, z in s and m ENU, vehicle)."
    )
    add = parser.add_argument
    add("files", type=Path, nargs="+", metavar="FILE", help="two or more runs; the first is the "
        "reference for the others")  # fmt: skip
    add("--names", metavar="NAMES", help="names of the runs, comma-separated (default: from their paths)")
    add("--align", choices=ALIGNMENTS, default="motion",
        help="zero of the times (default: the first motion of any vehicle)")  # fmt: skip
    add("--vehicle", metavar="NAME", help="compare this vehicle alone; in a run with a single one, that one")
    add("--from-place", action="store_true", help="positions relative to each vehicle's position at time 0")
    add("--out", type=Path, metavar="FOLDER", help="where the report goes (default: comparison, beside the first run)")


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    try:
        if not 2 <= len(arguments.files) <= _MOST_RUNS:
            raise OptionError(f"compare: {len(arguments.files)} runs are not allowed; 2 to {_MOST_RUNS}")
        names = names_of(arguments.files, arguments.names)
        folder = command_options.output_folder(arguments.out, arguments.files[0].with_name("comparison"))
        read = [read_run(file, name, find_formation) for file, name in zip(arguments.files, names, strict=True)]
        runs, time_name = aligned(matched(read, arguments.vehicle), arguments.align)
        if arguments.from_place:
            runs = [run.from_places() for run in runs]
        metrics = compare(runs)
        page = compare_page(runs, metrics, time_name.removesuffix(" [s]"))
        console = Console()
        print_page(page, console)
        write_page(page, metrics, pictures(runs, time_name), folder, console)
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except (BagError, LogError, RecordError, CompareError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0
