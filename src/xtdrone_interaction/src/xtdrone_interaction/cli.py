"""XTDrone's command line: ``python -m xtdrone_interaction demo formation``, ``... bench``, ``... report FILE``.

Exit status: 0 when all went well, 1 when the flight failed or missed its figures, 2 for a value that is not allowed,
128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from xtdrone_control.communication.arguments import ArgumentError
from xtdrone_control.fleet import FleetError, parse_fleet
from xtdrone_coordination.classes import load_class
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_coordination.patterns import PatternError
from xtdrone_interaction import formation_demo, options, search_cli, search_demo
from xtdrone_interaction.formation_demo import DemoSettings, run_demo
from xtdrone_interaction.launched import DemoError, master_port
from xtdrone_interaction.options import DEFAULT_FOLLOWER, OptionError, checked
from xtdrone_interaction.screen import PatientConsole
from xtdrone_interaction.search_cli import add_search
from xtdrone_interaction.search_prepare import is_search
from xtdrone_interaction.simplified_cli import add_simplified, run_simplified


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="xtdrone", description="XTDrone for ROS 1 and pybullet.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    demo = commands.add_parser("demo", help="fly a demonstration")
    demos = demo.add_subparsers(dest="demo", required=True, metavar="DEMO")
    _add_formation(demos.add_parser(
        "formation",
        help="UAVs take off, fly through formation patterns and land",
        description="Fly the formation demo: takeoff, origin, each pattern in turn with the leader moving between, "
        "origin, landing. Leaves runs/<time>/ with flight.bag, report.json, events.jsonl, pictures and logs.",
    ))  # fmt: skip
    simplified = demos.add_parser(
        "simplified",
        help="the same flight on the simplified simulator, on ROS or, with --without-ros, in one process",
        description="Fly the formation flight on the simplified simulator, compare it with full physics, and film it. "
        "Leaves runs/<time>/ with report.json, pictures, the film, and flight.bag (ROS) or flight.npz (--without-ros).",
    )
    add_simplified(simplified)
    search = demos.add_parser(
        "search",
        help="UAVs with cameras search a region for people",
        description="Fly the cooperative search: the region is divided, the plans go to the vehicles from the ground "
        "station, detectors look for people, a find is looked at again and followed. Leaves runs/<time>/ with "
        "flight.bag, report.json, map.png, the views as pictures and film, the plans and the world.",
    )
    add_search(search)
    report = commands.add_parser("report", help="make report and pictures of a recorded flight again")
    report.add_argument("file", type=Path, help="flight.bag of a run, or flight.npz of one without ROS")
    commands.add_parser("replay-check", help="fly one flight at other speeds, on one core, ...: it must be the same")
    commands.add_parser("launch", help="run a launch file and watch it (own options: launch --help)")
    commands.add_parser("sim", help="pause, step, reset, ... a running simulation (own options: sim --help)")
    commands.add_parser("gcs", help="plans to vehicles and back, as a ground station (own options: gcs --help)")
    commands.add_parser("analyse", help="report and pictures of any bag or flight log (own options: analyse --help)")
    commands.add_parser("compare", help="runs on the same axes (own options: compare --help)")
    commands.add_parser("convert", help="bags as ROS 2 bags, MCAP, CSV, Parquet (own options: convert --help)")
    commands.add_parser("record", help="record a running flight by a profile (own options: record --help)")
    commands.add_parser("bench", help="measure speed, memory and start-up on this machine (own options: bench --help)")
    commands.add_parser("soak", help="run one simulation for hours: does it grow? (own options: soak --help)")
    commands.add_parser("sweep", help="fly a study over parameters and seeds (own options: sweep --help)")
    commands.add_parser("record-view", help="film a flight as rviz shows it (own options: record-view --help)")
    commands.add_parser("compare-px4", help="fly our autopilot beside recorded flights of a real PX4")
    return parser


def _add_formation(parser: argparse.ArgumentParser) -> None:
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
    add("--pattern-file", type=Path, metavar="FILE", help="YAML file with patterns of your own")
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
        help="a process per vehicle and role, as in the paper, or one per role (default: %(default)s)")  # fmt: skip
    add("--follower", default=DEFAULT_FOLLOWER, metavar="PROGRAM",
        help="follower program of xtdrone_coordination, or FILE.py[:CLASS] with your own follower class "
        "(default: %(default)s)")  # fmt: skip
    add("--leader", metavar="FILE.py:CLASS", help="your own leader class (default: the shipped one)")
    add("--control", choices=["vel", "accel"], default="vel", help="what followers command (default: %(default)s)")
    add("--avoidance", choices=["own", "python", "cpp"], default="own",
        help="who computes the avoidance: every follower its own, or one node for all (Python, C++) "
        "(default: %(default)s)")  # fmt: skip
    add("--clearance", type=checked(lambda text: options.positive("clearance", text)), default=3.0, metavar="M",
        help="least height of any slot above the ground, m (default: %(default)s)")  # fmt: skip
    add("--world", default="empty", metavar="WORLD", help="world's name (default: %(default)s)")
    add("--headless", action="store_true", help="no live display: a line of progress every few seconds")
    add(
        "--logs", action="store_true", help="write the vehicles' flight logs (PX4's ULog) into the results' folder logs"
    )
    add("--out", type=Path, metavar="FOLDER", help="where results go, a new folder (default: runs/<time>)")
    options.add_master(parser)
    options.add_instance(parser)


def demo_settings(arguments: argparse.Namespace) -> DemoSettings:
    """Return the demo's settings after all checks that need no ROS.

    Raises:
        OptionError, PatternError, FleetError: a value that is not allowed.
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
    """Import the user's class here, too: its nodes would die of what is wrong with it a while after the start."""
    if not text:
        return
    try:
        load_class(text, base, what)
    except ArgumentError as error:
        raise OptionError(str(error)) from error


def _report_again(file: Path, console: Console) -> int:
    return (search_demo if is_search(file.parent) else formation_demo).report_again(file, console)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["replay-check"]:
        from xtdrone_interaction import replay_check

        return replay_check.main(arguments[1:])
    if arguments[:1] == ["launch"]:
        from xtdrone_interaction import launch_cli

        return launch_cli.main(arguments[1:])
    if arguments[:1] == ["sim"]:
        from xtdrone_interaction import sim_cli

        return sim_cli.main(arguments[1:])
    if arguments[:1] == ["gcs"]:
        from xtdrone_interaction.gcs import command as gcs

        return gcs.main(arguments[1:])
    if arguments[:1] == ["compare-px4"]:
        from xtdrone_interaction.compare_px4 import main as compare_px4

        return compare_px4.main(arguments[1:])
    if arguments[:1] == ["analyse"]:
        from xtdrone_interaction.analysis import command as analysis

        return analysis.main(arguments[1:])
    if arguments[:1] == ["compare"]:
        from xtdrone_interaction.analysis import compare

        return compare.main(arguments[1:])
    if arguments[:1] == ["convert"]:
        from xtdrone_interaction.analysis import convert

        return convert.main(arguments[1:])
    if arguments[:1] == ["record"]:
        from xtdrone_interaction import recording

        return recording.main(arguments[1:])
    if arguments[:1] == ["record-view"]:
        from xtdrone_interaction.rviz import record_view

        return record_view.main(arguments[1:])
    if arguments[:1] == ["bench"]:
        from xtdrone_interaction import bench

        return bench.main(arguments[1:])
    if arguments[:1] == ["soak"]:
        from xtdrone_interaction.soak import main as soak

        return soak.main(arguments[1:])
    if arguments[:1] == ["sweep"]:
        from xtdrone_interaction.sweep import main as sweep

        return sweep.main(arguments[1:])
    parsed = _parser().parse_args(arguments)
    console = PatientConsole()
    try:
        if parsed.command == "report":
            return _report_again(parsed.file, console)
        if parsed.demo == "search":
            return search_cli.run(parsed, console)
        if parsed.demo == "simplified":
            return run_simplified(parsed, console)
        return run_demo(demo_settings(parsed), console)
    except (OptionError, PatternError, FleetError) as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 2
    except DemoError as error:
        print(f"xtdrone: {error}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"xtdrone: {error.filename or 'system'}: {error.strerror or error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
