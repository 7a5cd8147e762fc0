"""``./xtdrone demo formation``: its options and their checks."""

from __future__ import annotations

import argparse
from pathlib import Path

from xtdrone_control.communication.arguments import ArgumentError
from xtdrone_control.fleet import parse_fleet
from xtdrone_coordination.classes import load_class
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_interaction import options
from xtdrone_interaction.formation_demo import DemoSettings, run_demo
from xtdrone_interaction.launched import master_port
from xtdrone_interaction.options import DEFAULT_FOLLOWER, OptionError, checked
from xtdrone_interaction.screen import PatientConsole, run_reported


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly the formation demo: takeoff, origin, each pattern in turn with the leader moving between, origin, "
        "landing. Leaves runs/<time>/ with flight.bag, report.json, events.jsonl, pictures and logs."
    )
    add = parser.add_argument
    add(
        "--n",
        type=checked(options.vehicle_count),
        default=9,
        metavar="N",
        help="number of vehicles (default: %(default)s)",
    )
    add("--type", default="iris", metavar="TYPE", help="vehicle type (default: %(default)s)")
    add("--patterns", type=checked(options.split_patterns), default=["cube", "pyramid", "triangle"], metavar="NAMES",
        help=options.PATTERNS_HELP)  # fmt: skip
    add("--pattern-file", type=Path, metavar="FILE", help="YAML file with your own patterns")
    add("--speed", type=checked(options.speed), default=0.0, metavar="FACTOR",
        help="target real-time factor, or 'unlimited' (default: unlimited)")  # fmt: skip
    add(
        "--seed",
        type=checked(options.seed),
        default=0,
        metavar="SEED",
        help="seed of all noise (default: %(default)s)",
    )
    add("--processes", choices=["per-uav", "shared"], default="per-uav",
        help="one process per vehicle and role, as in the paper, or one per role (default: %(default)s)")  # fmt: skip
    add("--follower", default=DEFAULT_FOLLOWER, metavar="PROGRAM",
        help="follower program of xtdrone_coordination, or FILE.py[:CLASS] with your own follower class "
        "(default: %(default)s)")  # fmt: skip
    add("--leader", metavar="FILE.py:CLASS", help="your own leader class (default: the shipped one)")
    add("--control", choices=["vel", "accel"], default="vel", help="what followers command (default: %(default)s)")
    add("--avoidance", choices=["own", "python", "cpp"], default="own",
        help="where the avoidance is computed: in every follower, or in one node for all (Python, C++) "
        "(default: %(default)s)")  # fmt: skip
    add("--clearance", type=checked(lambda text: options.positive("clearance", text)), default=3.0, metavar="M",
        help="minimum height of any slot above the ground, m (default: %(default)s)")  # fmt: skip
    add("--world", default="empty", metavar="WORLD", help="name of the world (default: %(default)s)")
    add("--headless", action="store_true", help="no live display: print a line of progress every few seconds")
    add(
        "--logs",
        action="store_true",
        help="write the vehicles' flight logs (PX4's ULog) to logs/ in the results",
    )
    add("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    options.add_master(parser)
    options.add_instance(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status."""
    return run_reported(lambda: run_demo(demo_settings(arguments), PatientConsole()))


def demo_settings(arguments: argparse.Namespace) -> DemoSettings:
    """Return the settings of the demo, after all checks that need no ROS.

    Raises:
        OptionError, PatternError, FleetError: a value is not allowed.
    """
    config = options.repository() / "src" / "xtdrone_sim" / "config"
    options.one_of_files("vehicle type", arguments.type, config / "vehicles")
    options.one_of_files("world", arguments.world, config / "worlds")
    fleet = f"{arguments.type}:{arguments.n}"
    parse_fleet(fleet)
    pattern_file = str(arguments.pattern_file.resolve()) if arguments.pattern_file else ""
    options.swarm_patterns(arguments.n, arguments.patterns, pattern_file or None)
    follower, follower_class = options.follower_program(arguments.follower)
    leader_class = options.leader_class(arguments.leader)
    _check_class(follower_class, Follower, "follower")
    _check_class(leader_class, Leader, "leader")
    return DemoSettings(
        n=arguments.n,
        type=arguments.type,
        patterns=arguments.patterns,
        pattern_file=pattern_file,
        processes=arguments.processes.replace("-", "_"),
        follower=follower,
        follower_class=follower_class,
        control=arguments.control,
        avoidance=arguments.avoidance,
        clearance=arguments.clearance,
        world=arguments.world,
        seed=arguments.seed,
        speed=arguments.speed,
        out=options.results_folder(arguments.out, recorded=True),
        master_port=master_port(arguments.master_port, use_running=arguments.use_master),
        headless=arguments.headless,
        logs=arguments.logs,
        leader_class=leader_class,
        instance=options.take_instance(fleet, arguments.instance),
    )


def _check_class(text: str, base: type, what: str) -> None:
    """Import the user's class before the start, so that an error in it is reported here and not by dying nodes."""
    if not text:
        return
    try:
        load_class(text, base, what)
    except ArgumentError as error:
        raise OptionError(str(error)) from error
