"""``./xtdrone report``: make the report of a recorded flight again."""

from __future__ import annotations

import argparse
from pathlib import Path

from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos import forest_demo, formation_demo, search_demo
from xtdrone_interaction.demos.search_prepare import is_search


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the argument."""
    parser.description = "Make the report and the pictures of a recorded flight again, beside the recording."
    parser.add_argument("file", type=Path, help="flight.bag of a run, or flight.npz of one without ROS")


def run(arguments: argparse.Namespace) -> int:
    """Make the report and return the exit status."""
    folder = arguments.file.parent
    demo = search_demo if is_search(folder) else forest_demo if forest_demo.is_forest(folder) else formation_demo
    return run_reported(lambda: demo.report_again(arguments.file, PatientConsole()))
