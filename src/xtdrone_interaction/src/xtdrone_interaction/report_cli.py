"""``./xtdrone report``: make the report of a recorded flight again."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.console import Console

from xtdrone_interaction.console import PatientConsole, run_reported


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument."""
    parser.description = "Make the report and the pictures of a recorded flight again, beside the recording."
    parser.add_argument("file", type=Path, help="flight.bag of a run, or flight.npz of one without ROS")


def run(arguments: argparse.Namespace) -> int:
    """Make the report and return the exit status."""
    return run_reported(lambda: _report(arguments.file, PatientConsole()))


def _report(file: Path, console: Console) -> int:
    from xtdrone_interaction.missions.kinds import mission_of  # imports Matplotlib, which is slow
    from xtdrone_interaction.missions.mission import make_report_again, save_report
    from xtdrone_interaction.report.html_page import print_page

    made = make_report_again(mission_of(file), file)
    print_page(made.page, console)  # first: the disk may be full
    return save_report(made, file.parent, console)
