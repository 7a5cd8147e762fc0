"""``./xtdrone report``: make the report of a recorded flight again."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos import formation_demo, landing_cli, search_demo
from xtdrone_interaction.demos.search_prepare import is_search


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument."""
    parser.description = "Make the report and the pictures of a recorded flight again, beside the recording."
    parser.add_argument("file", type=Path, help="flight.bag of a run, or flight.npz of one without ROS")


def run(arguments: argparse.Namespace) -> int:
    """Make the report and return the exit status."""
    report_again: Callable[[Path, Console], int] = formation_demo.report_again
    if is_search(arguments.file.parent):
        report_again = search_demo.report_again
    elif landing_cli.is_landing(arguments.file):
        report_again = landing_cli.report_again
    return run_reported(lambda: report_again(arguments.file, PatientConsole()))
