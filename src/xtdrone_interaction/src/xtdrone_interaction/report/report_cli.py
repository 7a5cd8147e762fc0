"""``./xtdrone report``: make the report of a recorded flight again."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos import forest_demo, landing_demo, slam_demo
from xtdrone_interaction.demos.formation import formation_demo
from xtdrone_interaction.demos.search import search_demo
from xtdrone_interaction.demos.search.search_prepare import is_search


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument."""
    parser.description = "Make the report and the pictures of a recorded flight again, beside the recording."
    parser.add_argument("file", type=Path, help="flight.bag of a run, or flight.npz of one without ROS")


def run(arguments: argparse.Namespace) -> int:
    """Make the report and return the exit status."""
    return run_reported(lambda: _maker(arguments.file)(arguments.file, PatientConsole()))


def _maker(bag: Path) -> Callable[[Path, Console], int]:
    """Return the function that makes the report of this kind of flight."""
    if is_search(bag.parent):
        return search_demo.report_again
    if forest_demo.is_forest(bag.parent):
        return forest_demo.report_again
    if landing_demo.is_landing(bag):
        return landing_demo.report_again
    if slam_demo.is_slam(bag.parent):
        return slam_demo.report_again
    return formation_demo.report_again
