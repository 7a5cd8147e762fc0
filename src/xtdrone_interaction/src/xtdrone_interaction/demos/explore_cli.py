"""``./xtdrone demo explore``: its options and their checks."""

from __future__ import annotations

import argparse
from dataclasses import replace

from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos.directed_flight import add_place_options, placed
from xtdrone_interaction.demos.explore_demo import ExploreDemoSettings, run_explore


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Explore a floor of rooms with several UAVs: each maps what its lidar sees, flies to the frontiers of known "
        "space, and shares its map and regions with the others, until the floor is explored. Leaves runs/<time>/ with "
        "flight.bag, report.json and floor.png."
    )
    settings = ExploreDemoSettings.add_arguments
    settings(parser, ("n", "length", "width", "delay", "loss", "merge", "speed_limit", "seed"))
    parser.add_argument(
        "--world", metavar="WORLD", help="another world, by name or file (default: a building generated from the seed)"
    )
    settings(parser, ("bounds", "time_limit", "speed", "headless", "web"))
    add_place_options(parser)


def settings_of(arguments: argparse.Namespace) -> ExploreDemoSettings:
    """Return the settings of the flight, validated as far as possible without ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    settings = ExploreDemoSettings.from_arguments(arguments, world="")
    if settings.merge and settings.n < 2:
        raise OptionError(f"n: {settings.n} is not allowed with --merge, 2 to 6")
    settings = replace(settings, world=command_options.world(arguments.world or settings.generated_world))
    return placed(settings, arguments, settings.fleet)


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status; see :func:`~xtdrone_interaction.demos.explore_demo.run_explore`."""
    return run_reported(lambda: run_explore(settings_of(arguments), PatientConsole()))
