"""``./xtdrone demo forest``: its options and their checks."""

from __future__ import annotations

import argparse
from dataclasses import replace

from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.demos.directed_flight import add_place_options, placed
from xtdrone_interaction.demos.forest_demo import ForestDemoSettings, run_forest
from xtdrone_planning.planner_settings import PlannerSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly a UAV through an unknown forest, by lidar or depth camera: it maps what it sees, plans a smooth "
        "trajectory and replans as it sees more. With --formation several UAVs cross it behind their leader, "
        "and re-form. Leaves runs/<time>/ with flight.bag, report.json, map.png and a film."
    )
    settings = ForestDemoSettings.add_arguments
    settings(
        parser, ("n", "sensor", "planner", "delay", "loss", "speed_limit", "acceleration_limit", "density", "seed")
    )
    parser.add_argument(
        "--world", metavar="WORLD", help="another world, by name or file (default: a forest generated from the seed)"
    )
    settings(parser, ("formation", "leader_speed"))
    parser.add_argument(
        "--follower", metavar="FILE.py[:CLASS]",
        help="your own follower class (default: the example ForestFollower, which keeps up with the leader)",
    )  # fmt: skip
    parser.add_argument("--leader", metavar="FILE.py:CLASS", help="your own leader class (default: the shipped one)")
    settings(parser, ("start", "goal", "highest", "time_limit", "speed", "headless", "logs", "web"))
    parser.add_argument(
        "--no-film", dest="film", action="store_false", help="no film of the flight, flight.mp4, after its end"
    )
    add_place_options(parser)


def settings_of(arguments: argparse.Namespace) -> ForestDemoSettings:
    """Return the settings of the flight, validated as far as possible without ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    settings = ForestDemoSettings.from_arguments(arguments, world="", film=arguments.film)
    settings = replace(settings, world=command_options.world(arguments.world or settings.generated_world))
    settings = replace(
        settings,
        follower_class=command_options.follower_class(arguments.follower),
        leader_class=command_options.leader_class(arguments.leader),
    )
    _check_formation(settings)
    return placed(settings, arguments, settings.fleet)


def _check_formation(settings: ForestDemoSettings) -> None:
    """Check the settings of a formation.

    Raises:
        OptionError, PatternError: a value is not allowed.
    """
    if not settings.formation:
        for name, given in (("follower", settings.follower_class), ("leader", settings.leader_class)):
            if given:
                raise OptionError(f"{name}: {given!r} is not allowed without --formation")
        return
    if settings.n < 2:
        raise OptionError(f"n: {settings.n} is not allowed with --formation, 2 to 12")
    heights = (
        settings.goal[2] + command_options.swarm_patterns(settings.n, [settings.formation])[settings.formation][:, 2]
    )
    lowest = PlannerSettings().lowest
    if heights.min() < lowest or heights.max() > settings.highest:
        raise OptionError(
            f"formation: {settings.formation!r} is not allowed, its slots are at {heights.min():g} to "
            f"{heights.max():g} m; {lowest:g} to {settings.highest:g} m (--highest)"
        )
    command_options.checked_class(settings.follower_class, Follower, "follower")
    command_options.checked_class(settings.leader_class, Leader, "leader")


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status; see :func:`~xtdrone_interaction.demos.forest_demo.run_forest`."""
    return run_reported(lambda: run_forest(settings_of(arguments), PatientConsole()))
