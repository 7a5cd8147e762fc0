"""``./xtdrone demo forest``: its options and their checks."""

from __future__ import annotations

import argparse
from dataclasses import replace

from xtdrone_interaction import options
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos.directed_flight import add_place_options, placed
from xtdrone_interaction.demos.forest_demo import ForestDemoSettings, run_forest


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly a UAV through a forest that it does not know, by lidar or depth camera: it maps what it sees, plans a "
        "smooth trajectory through it and replans as it sees more. Leaves runs/<time>/ with flight.bag, report.json, "
        "map.png and a film."
    )
    settings = ForestDemoSettings.add_arguments
    settings(parser, ("n", "sensor", "delay", "loss", "speed_limit", "acceleration_limit", "density", "seed"))
    parser.add_argument(
        "--world", metavar="WORLD", help="another world, by name or file (default: a forest of the seed)"
    )
    settings(parser, ("start", "goal", "highest", "time_limit", "speed", "headless", "logs", "web"))
    parser.add_argument(
        "--no-film", dest="film", action="store_false", help="no film of the flight, flight.mp4, after its end"
    )
    add_place_options(parser)


def settings_of(arguments: argparse.Namespace) -> ForestDemoSettings:
    """Return the settings of the flight, after all checks that need no ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    settings = ForestDemoSettings.from_arguments(arguments, world="", film=arguments.film)
    settings = replace(settings, world=options.world(arguments.world or settings.generated_world))
    return placed(settings, arguments, settings.fleet)


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status; see :func:`~xtdrone_interaction.demos.forest_demo.run_forest`."""
    return run_reported(lambda: run_forest(settings_of(arguments), PatientConsole()))
