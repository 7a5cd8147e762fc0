"""``./xtdrone demo search``: its options and their checks."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from xtdrone_control.fleet import parse_fleet
from xtdrone_interaction.command_options import (
    MachineSettings,
    OptionError,
    add_instance,
    add_master,
    results_folder,
    take_instance,
)
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos.search.search_demo import run_search
from xtdrone_interaction.demos.search.search_prepare import SearchSettings
from xtdrone_interaction.launching.supervised_launch import master_port


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly the cooperative search: the region is divided, the ground station uploads the plans to the vehicles, "
        "detectors look for people, a find is inspected a second time and followed. Leaves runs/<time>/ with "
        "flight.bag, report.json, map.png, the views as pictures and film, the plans and the world."
    )
    add = parser.add_argument
    options = SearchSettings.add_arguments
    options(parser, ("n", "type", "seed", "persons", "walking"))
    add("--region", type=Path, metavar="FILE",
        help="YAML file with region: [[x, y], ...] and holes: [...], m in map (default: the shipped one)")  # fmt: skip
    add("--plans", type=Path, metavar="FOLDER",
        help="your own VEHICLE.plan files in QGroundControl's format (default: made for the region)")  # fmt: skip
    add("--world", metavar="WORLD", help="your own world, by name or file (default: generated from the seed)")
    options(parser, ("height", "on_find", "follow_time", "time_limit", "camera_rate", "speed", "film"))
    options(parser, ("headless", "logs", "web"))
    add("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    add_master(parser)
    add_instance(parser)


def settings_of(arguments: argparse.Namespace) -> SearchSettings:
    """Return the settings of the search, after all checks that need no ROS.

    Raises:
        OptionError, FleetError: a value is not allowed.
    """
    settings = SearchSettings.from_arguments(
        arguments,
        region=_path(arguments.region, "region"),
        plans=_path(arguments.plans, "plans"),
        world=arguments.world or "",
    )
    fleet = f"{settings.type}:{settings.n}"
    parse_fleet(fleet)
    if settings.world and settings.persons != 1:
        raise OptionError("persons: they are in the world's file; leave out --persons where --world is given")
    machine = MachineSettings.from_arguments(arguments)
    return replace(
        settings,
        out=results_folder(arguments.out, recorded=True),
        master_port=master_port(machine.master_port, use_running=arguments.use_master),
        instance=take_instance(fleet, machine.instance),
    )


def _path(wanted: Path | None, name: str) -> str:
    if wanted is None:
        return ""
    if not wanted.exists():
        raise OptionError(f"{name}: {str(wanted)!r} does not exist")
    return str(wanted.resolve())


def run(arguments: argparse.Namespace) -> int:
    """Search and return the exit status; see :func:`~xtdrone_interaction.demos.search.search_demo.run_search`."""
    return run_reported(lambda: run_search(settings_of(arguments), PatientConsole()))
