"""``./xtdrone demo forest``: its options and their checks."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from xtdrone_interaction import options
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos.forest_demo import ForestDemoSettings, run_forest
from xtdrone_interaction.launching.supervised_launch import master_port
from xtdrone_interaction.options import MachineSettings, add_instance, add_master, results_folder, take_instance


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly a UAV through a forest that it does not know, by lidar or depth camera: it maps what it sees, plans a "
        "smooth trajectory through it and replans as it sees more. Leaves runs/<time>/ with flight.bag, report.json "
        "and map.png."
    )
    settings = ForestDemoSettings.add_arguments
    settings(parser, ("n", "sensor", "delay", "loss", "speed_limit", "acceleration_limit", "density", "seed"))
    parser.add_argument(
        "--world", metavar="WORLD", help="another world, by name or file (default: a forest of the seed)"
    )
    settings(parser, ("start", "goal", "highest", "time_limit", "speed", "headless", "logs", "web"))
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    add_master(parser)
    add_instance(parser)


def settings_of(arguments: argparse.Namespace) -> ForestDemoSettings:
    """Return the settings of the flight, after all checks that need no ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    settings = ForestDemoSettings.from_arguments(arguments, world="")
    settings = replace(settings, world=options.world(arguments.world or settings.generated_world))
    machine = MachineSettings.from_arguments(arguments)
    return replace(
        settings,
        out=results_folder(arguments.out, recorded=True),
        master_port=master_port(machine.master_port, use_running=arguments.use_master),
        instance=take_instance(settings.fleet, machine.instance),
    )


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status; see :func:`~xtdrone_interaction.demos.forest_demo.run_forest`."""
    return run_reported(lambda: run_forest(settings_of(arguments), PatientConsole()))
