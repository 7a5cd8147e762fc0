"""``./xtdrone analyse FILE``: report and pictures of a bag or of a flight log.

Exit status: 0 when a report was written, 1 when nothing can be read, 2 for a value that is not allowed, 128 + n when
stopped by signal n.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from xtdrone_interaction.analysis.page import Page, save_page
from xtdrone_interaction.analysis.ros1bag import BagError
from xtdrone_interaction.analysis.ulog import LogError, is_log, read_log
from xtdrone_interaction.options import OptionError

_PRINTED_ROWS = 40  # of a table on the terminal


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    parser.description = (
        "Write report and pictures of a recorded flight: report.html, which needs no other file, the "
        "pictures as PNG, and report.json. No ROS is needed."
    )
    add = parser.add_argument
    add("files", type=Path, nargs="+", metavar="FILE", help="ROS 1 bag or ULog, also one that a crash cut off, or "
        "ROS 2 bag; or the bags of a recording that was split")  # fmt: skip
    add("--part", type=int, metavar="N", help="of a bag in which time was set back (default: the longest)")
    add("--out", type=Path, metavar="FOLDER", help="where the report goes (default: <file>-analysis beside the file)")


def output_folder(wanted: Path | None, file: Path, ending: str) -> Path:
    """Return the folder of results, made if need be: that which is wanted, or one beside the file.

    Raises:
        OptionError: it cannot be made or written to.
    """
    folder = wanted or file.with_name(f"{file.stem}{ending}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OptionError(f"out: {str(folder)!r} cannot be written to: {error.strerror}") from error
    return folder


def analyse(files: Sequence[Path], folder: Path, console: Console, part: int | None = None) -> None:
    """Write the report of a bag or a flight log, and print what it says.

    Args:
        files: bag or flight log; or several bags of one recording.
        folder: gets the report.
        console: to print on.
        part: of a bag in which time was set back, from 1; None for the longest.

    Raises:
        BagError, LogError: nothing can be read of it.
    """
    logs = [file for file in files if is_log(file) or file.suffix == ".ulg"]
    if logs and len(files) > 1:
        raise LogError(f"analyse: {str(logs[0])!r} is a flight log, of which one is analysed at a time; see compare")
    if logs:
        _analyse_log(logs[0], folder, console)
        return
    from xtdrone_interaction.analysis.flight import read_flight  # these take a while to import
    from xtdrone_interaction.analysis.formation import formation_record
    from xtdrone_interaction.analysis.pictures import pictures
    from xtdrone_interaction.analysis.summary import flight_page, summarise

    flight = read_flight(files, part=part)
    if not flight.topics:
        raise BagError("; ".join([f"bag: {str(files[0])!r} has no messages that can be read", *flight.notes]))
    record = formation_record(flight)
    figures = summarise(flight, record)
    page = flight_page(flight, figures)
    shown = pictures(flight, record if figures["formation"] else None)
    finish(page, figures, save_page(page, shown, folder), folder, console)


def _analyse_log(file: Path, folder: Path, console: Console) -> None:
    from xtdrone_interaction.analysis.ulog_pictures import pictures
    from xtdrone_interaction.analysis.ulog_summary import log_page, summarise

    log = read_log(file)
    figures = summarise(log)
    page = log_page(log, figures)
    finish(page, figures, save_page(page, pictures(log), folder), folder, console)


def finish(page: Page, figures: object, paths: Sequence[Path], folder: Path, console: Console) -> None:
    """Write the figures as JSON, and print a report and where it is."""
    data = folder / "report.json"
    data.write_text(json.dumps(_known(figures), indent=2, allow_nan=False) + "\n", encoding="utf-8")
    print_page(page, console)
    for path in [paths[0], data, *paths[1:]]:
        console.print(f"  {path}", highlight=False, soft_wrap=True, markup=False)


def _known(figures: Any) -> Any:
    """Return figures with None for what is not known, which JSON has no number for."""
    if isinstance(figures, dict):
        return {key: _known(value) for key, value in figures.items()}
    if isinstance(figures, list | tuple):
        return [_known(value) for value in figures]
    return None if isinstance(figures, float) and not math.isfinite(figures) else figures


def print_page(page: Page, console: Console) -> None:
    """Print the words of a report, without its long tables."""
    console.print(f"[bold]{escape(page.title)}[/bold]", highlight=False)
    console.print(escape(page.summary), highlight=False)
    for table in page.tables:
        if table.long or not table.rows:
            continue
        printed = RichTable(
            title=table.title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
        )
        for column, name in enumerate(table.head):
            left = column == 0 or column in table.texts
            printed.add_column(name, justify="left" if left else "right", no_wrap=column == 0)
        for row in table.rows[:_PRINTED_ROWS]:
            printed.add_row(*(escape(cell) for cell in row))
        console.print(printed)
    for note in page.notes:
        console.print(f"[yellow]Note:[/yellow] {escape(note)}", highlight=False, soft_wrap=True)


def run(arguments: argparse.Namespace) -> int:
    """Run the command and return its exit status."""
    try:
        for file in arguments.files:
            if not file.exists():
                raise BagError(f"analyse: {str(file)!r} does not exist")
        folder = output_folder(arguments.out, arguments.files[0], "-analysis")
        analyse(arguments.files, folder, Console(), arguments.part)
    except OptionError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except (BagError, LogError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1
    return 0
