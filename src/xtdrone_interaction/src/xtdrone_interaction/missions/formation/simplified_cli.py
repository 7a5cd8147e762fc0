"""``./xtdrone demo simplified``: its options and their checks."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

from xtdrone_common.fleet import MAX_VEHICLES, parse_fleet
from xtdrone_common.programs.user_classes import load_class, nothing_overridden
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_coordination.network import NetworkOptions
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import DEFAULT_FOLLOWER, MachineSettings, OptionError
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.launching.supervised_launch import master_port
from xtdrone_interaction.missions.formation.cli import FormationSettings, waive_criteria
from xtdrone_interaction.missions.formation.compare_simulators import check_comparable
from xtdrone_interaction.missions.formation.record import FormationRecord, read_formation
from xtdrone_interaction.missions.formation.simplified import (
    MOST_COMPARED,
    FilmSettings,
    SwarmSettings,
    run_in_process,
    run_on_ros,
)
from xtdrone_interaction.recording.topics import ORIGIN

WINDOW_SPEED = 10.0  # default real-time factor with a window
_NETWORK = ("range", "delay", "jitter", "loss", "bandwidth")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly the formation flight on the simplified simulator, compare it with full physics, and film it. Leaves "
        "runs/<time>/ with report.html, report.json, pictures, the film, and flight.bag (ROS) or flight.npz "
        "(--without-ros)."
    )
    add = parser.add_argument
    add("--without-ros", action="store_true",
        help="fly in one process, without a ROS master: thousands of vehicles, as fast as the machine can")  # fmt: skip
    SwarmSettings.add_arguments(parser, ("n", "kind", "patterns"))
    add("--pattern-file", type=Path, metavar="FILE", help="YAML file with your own patterns")
    SwarmSettings.add_arguments(parser, ("model", "speed", "seed"))
    add("--follower", default=DEFAULT_FOLLOWER, metavar="FILE.py:CLASS",
        help="your own follower class (default: the shipped one)")  # fmt: skip
    add("--leader", metavar="FILE.py:CLASS", help="your own leader class (default: the shipped one)")
    SwarmSettings.add_arguments(parser, ("control", "clearance", "waive"))
    add("--film", metavar="FILE", help=".mp4, .gif or .png, or none "
        "(default: flight.mp4 in the results folder if there is no window)")  # fmt: skip
    add("--compare", action=argparse.BooleanOptionalAction, default=None,
        help=f"also fly the flight in full physics and compare (default: up to {MOST_COMPARED} vehicles)")  # fmt: skip
    add("--compare-with", type=Path, metavar="FILE",
        help="compare with a recorded flight instead: flight.bag of './xtdrone demo formation'")  # fmt: skip
    network = parser.add_argument_group("network", "Communication between the vehicles; only with --without-ros.")
    NetworkOptions.add_arguments(network, _NETWORK)
    add("--processes", choices=["per-uav", "merged", "shared"], default="per-uav",
        help="on ROS: a process per vehicle and role, one per vehicle, or one per role "
        "(default: %(default)s)")  # fmt: skip
    SwarmSettings.add_arguments(parser, ("headless",))
    FormationSettings.add_arguments(parser, ("web",))
    add("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    command_options.add_master(parser)


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status."""
    return run_reported(lambda: _fly(arguments))


def _fly(arguments: argparse.Namespace) -> int:
    console = PatientConsole()
    try:
        settings, film = swarm_settings(arguments)
        if arguments.without_ros and hasattr(arguments, "web"):
            raise OptionError("web: --web is not available with --without-ros, the page shows a flight on ROS")
        demo = None if arguments.without_ros else ros_settings(arguments, settings, film)
    except OptionError:
        raise
    except ValueError as error:  # of patterns, fleet, model, network, film, or a class
        raise OptionError(str(error)) from error
    if demo is None:
        for cls, base in ((settings.follower, Follower), (settings.leader, Leader)):
            warning = nothing_overridden(cls, base)
            if warning:
                print(f"xtdrone: {warning}", file=sys.stderr)
        return run_in_process(settings, film, console)
    return run_on_ros(demo, settings, film, console)


def swarm_settings(arguments: argparse.Namespace) -> tuple[SwarmSettings, FilmSettings]:
    """Return the settings of the flight and of its film, after all checks.

    Raises:
        ValueError: a value is not allowed.
    """
    from xtdrone_swarm.simplified.vehicle_parameters import load_model
    from xtdrone_swarm.view import can_open

    leader = command_options.leader_class(arguments.leader)
    settings = SwarmSettings.from_arguments(
        arguments,
        pattern_file=str(arguments.pattern_file.resolve()) if arguments.pattern_file else "",
        follower=_follower(arguments.follower),
        leader=load_class(leader, Leader, "leader") if leader else Leader,
        network=_network(arguments),
        compare_with=arguments.compare_with,
    )
    config = command_options.repository() / "src" / "xtdrone_worlds" / "config"
    command_options.one_of_files("vehicle type", settings.kind, config / "vehicles")
    if settings.model.endswith((".yaml", ".yml")):
        settings = replace(settings, model=str(Path(settings.model).resolve()))
    load_model(settings.kind, settings.model or None)
    command_options.swarm_patterns(settings.n, settings.patterns, settings.pattern_file or None)
    window = not settings.headless and can_open()
    if not hasattr(arguments, "speed") and window:
        settings = replace(settings, speed=WINDOW_SPEED)
    settings = replace(
        settings,
        waive=waive_criteria(settings.leader, settings.waive),
        compare=_compare(arguments, settings.n),
        recorded=_recorded(arguments.compare_with, settings),
        out=command_options.results_folder(arguments.out),
    )
    return settings, FilmSettings(_film(arguments.film, settings.out, window=window), window)


def ros_settings(arguments: argparse.Namespace, settings: SwarmSettings, film: FilmSettings) -> FormationSettings:
    """Return the settings of the flight on ROS.

    Raises:
        ValueError: a setting is not available on ROS, or a port is taken.
    """
    if settings.n > MAX_VEHICLES:
        raise OptionError(
            f"number of vehicles: '{settings.n}' is not allowed on ROS, 2 to {MAX_VEHICLES}; --without-ros flies more"
        )
    for name in _NETWORK:
        if hasattr(arguments, name):
            raise OptionError(f"{name}: --{name} is available in one process only; add --without-ros")
    follower, follower_class = command_options.follower_program(arguments.follower)
    parse_fleet(f"{settings.kind}:{settings.n}")  # binds no port: there is no MAVLink
    return FormationSettings(
        n=settings.n,
        type=settings.kind,
        patterns=settings.patterns,
        pattern_file=settings.pattern_file,
        processes=arguments.processes.replace("-", "_"),
        follower=follower,
        follower_class=follower_class,
        control=settings.control,
        avoidance="own",
        clearance=settings.clearance,
        waive=settings.waive,
        world="empty",
        seed=settings.seed,
        speed=settings.speed,
        out=settings.out,
        master_port=master_port(
            MachineSettings.from_arguments(arguments).master_port, use_running=arguments.use_master
        ),
        headless=settings.headless,
        logs=False,
        simulator="simplified",
        model=settings.model,
        leader_class=command_options.leader_class(arguments.leader),
        window=film.window,
        film=False,
        web=getattr(arguments, "web", False),
    )


def _follower(text: str) -> type[Follower]:
    _, file = command_options.follower_program(text)
    return load_class(file, Follower, "follower") if file else Follower


def _network(arguments: argparse.Namespace) -> NetworkOptions | None:
    if not any(hasattr(arguments, name) for name in _NETWORK):
        return None
    return NetworkOptions.from_arguments(arguments)


def _compare(arguments: argparse.Namespace, count: int) -> bool:
    if arguments.compare_with is not None:
        if arguments.compare is False:
            raise OptionError("comparison: --no-compare and --compare-with contradict each other")
        return False
    if arguments.compare and count > MAX_VEHICLES:
        raise OptionError(
            f"comparison: {count} vehicles are not allowed in full physics, {MAX_VEHICLES} at most; leave out --compare"
        )
    return bool(count <= MOST_COMPARED if arguments.compare is None else arguments.compare)


def _recorded(file: Path | None, settings: SwarmSettings) -> FormationRecord | None:
    """Return the recorded flight to compare with, None without one.

    Raises:
        OptionError: the file does not exist, or the flight has other vehicles or patterns.
    """
    if file is None:
        return None
    if not file.is_file():
        raise OptionError(f"comparison: {file} does not exist; flight.bag of a formation flight is needed")
    record = read_formation(file)
    check_comparable(record, settings.n, [ORIGIN, *settings.patterns, ORIGIN])
    return record


def _film(wanted: str | None, out: Path, *, window: bool) -> Path | None:
    """Return the file of the film, None for no film."""
    from xtdrone_interaction.missions.mission import film_file  # imports Matplotlib
    from xtdrone_swarm.view import check_film

    if wanted == "none" or (wanted is None and window):
        return None
    if wanted is None:
        return film_file(out)
    return check_film(Path(wanted).resolve())
