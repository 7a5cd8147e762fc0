"""``./xtdrone demo formation``: its options and their checks."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from xtdrone_control.fleet import parse_fleet, with_poses
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import DEFAULT_FOLLOWER, MachineSettings, OptionError
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos.formation.formation_demo import DemoSettings, run_demo, waived_criteria
from xtdrone_interaction.launching.supervised_launch import master_port
from xtdrone_sim.vehicles.vehicle_model import load_vehicle


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly the formation demo: takeoff, origin, each pattern in turn with the leader moving between, origin, "
        "landing. Leaves runs/<time>/ with flight.bag, report.json, events.jsonl, pictures, a film and logs."
    )
    add = parser.add_argument
    DemoSettings.add_arguments(parser, ("n", "type", "poses", "patterns"))
    add("--pattern-file", type=Path, metavar="FILE", help="YAML file with your own patterns")
    DemoSettings.add_arguments(parser, ("speed", "seed"))
    add("--processes", choices=["per-uav", "merged", "shared"], default="per-uav",
        help="one process per vehicle and role, as in the paper; one per vehicle; or one per role "
        "(default: %(default)s)")  # fmt: skip
    add("--follower", default=DEFAULT_FOLLOWER, metavar="PROGRAM",
        help="follower program of xtdrone_coordination, or FILE.py[:CLASS] with your own follower class "
        "(default: %(default)s)")  # fmt: skip
    add("--leader", metavar="FILE.py:CLASS", help="your own leader class (default: the shipped one)")
    DemoSettings.add_arguments(
        parser, ("control", "avoidance", "neighbours", "clearance", "waive", "headless", "logs", "web")
    )
    command_options.add_world(parser)
    add("--no-film", dest="film", action="store_false", help="no film of the flight, flight.mp4, after its end")
    add("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    command_options.add_master(parser)
    command_options.add_instance(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status."""
    return run_reported(lambda: run_demo(demo_settings(arguments), PatientConsole()))


def demo_settings(arguments: argparse.Namespace) -> DemoSettings:
    """Return the settings of the demo, after all checks that need no ROS.

    Raises:
        OptionError, PatternError, FleetError: a value is not allowed.
    """
    follower, follower_class = command_options.follower_program(arguments.follower)
    settings = DemoSettings.from_arguments(
        arguments,
        pattern_file=str(arguments.pattern_file.resolve()) if arguments.pattern_file else "",
        processes=arguments.processes.replace("-", "_"),
        follower=follower,
        follower_class=follower_class,
        leader_class=command_options.leader_class(arguments.leader),
        world=command_options.world(arguments.world),
        film=arguments.film,
    )
    config = command_options.repository() / "src" / "xtdrone_sim" / "config"
    command_options.one_of_files("vehicle type", settings.type, config / "vehicles")
    if settings.neighbours == "estimated" and not any(mount.bearing for mount in load_vehicle(settings.type).uwb):
        raise OptionError(
            f"neighbours: 'estimated' needs a type whose UWB sensor measures bearings, as iris_uwb_bearing, not "
            f"{settings.type!r}: ranges alone tell no positions while followers wait for them"
        )
    fleet = f"{settings.type}:{settings.n}"
    with_poses(parse_fleet(fleet), settings.poses)
    command_options.swarm_patterns(settings.n, settings.patterns, settings.pattern_file or None)
    command_options.checked_class(settings.follower_class, Follower, "follower")
    leader = command_options.checked_class(settings.leader_class, Leader, "leader")
    machine = MachineSettings.from_arguments(arguments)
    return replace(
        settings,
        waive=waived_criteria(leader, settings.waive),
        out=command_options.results_folder(arguments.out, recorded=True),
        master_port=master_port(machine.master_port, use_running=arguments.use_master),
        instance=command_options.take_instance(fleet, machine.instance),
    )
