"""``./xtdrone demo landing``: a UAV finds a ground robot that drives by its AprilTags, and lands on it.

Exit status: 0 for a landing within 0.15 m of the centre of the tags, 1 for another one or a failed flight, 2 for an
invalid value, 128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
import math
import random
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rich.console import Console

from xtdrone_common.settings import setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import seed_setting
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.launching.supervised_launch import Flight
from xtdrone_interaction.missions.demo import (
    DemoSettings,
    add_common_options,
    directed_flight,
    fly_directed,
    take_place,
)
from xtdrone_interaction.missions.landing.metrics import ROBOT, TYPE
from xtdrone_interaction.monitoring.progress_display import Display

if TYPE_CHECKING:
    from xtdrone_interaction.missions.mission import Mission

_SPAWN = (0.0, 3.0)  # m, of the UAV
_AWAY = 11.0  # m, of the robot at the start: out of sight
_ASIDE = 0.12  # rad, maximum angle between its heading and the UAV
_WORDS = {
    "tags found": "the platform is in sight: [bold]AUTO.PRECLAND[/bold]",
    "no tags found": "[yellow]no tags found: landing here[/yellow]",
    "landing given up": "[yellow]landing aborted[/yellow]",
}


@dataclass(frozen=True, kw_only=True)
class LandingDemoSettings(DemoSettings):
    """Settings of the flight."""

    ugv_speed: float = setting(1.0, low=0.0, high=1.4, unit="m/s", metavar="V", text="speed of the robot")
    ugv_turn: float = setting(0.0, low=-0.3, high=0.3, unit="rad/s", metavar="W", text="yaw rate of the robot")
    seed: int = seed_setting("seed of all noise, and of the robot's place")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Land on a driving robot: a UAV with a camera that looks down takes off, searches for the robot's AprilTags "
        "and lands on them by PX4's precision landing. Leaves runs/<time>/ with flight.bag, report.html, report.json, "
        "events.jsonl and landing.png."
    )
    LandingDemoSettings.add_arguments(parser, ("ugv_speed", "ugv_turn"))
    add_common_options(parser, LandingDemoSettings)


def run(arguments: argparse.Namespace) -> int:
    """Land and return the exit status."""
    return run_reported(lambda: fly(settings_of(arguments), PatientConsole()))


def settings_of(arguments: argparse.Namespace) -> LandingDemoSettings:
    """Return the settings, after all checks that need no ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    settings = LandingDemoSettings.from_arguments(arguments, world=command_options.world(arguments.world))
    return take_place(settings, arguments, f"{TYPE}:1")


def fly(settings: LandingDemoSettings, console: Console) -> int:
    """Fly the landing and return the exit status."""
    return fly_directed(load_mission, flight(settings), settings, console)


def load_mission() -> Mission:
    """Return the kind of the flight."""
    from xtdrone_interaction.missions.landing.report import LandingMission  # imports Matplotlib, which is slow

    return LandingMission()


def flight(settings: LandingDemoSettings) -> Flight:
    """Return the launch file with its arguments."""
    place = ", ".join(f"{value:g}" for value in robot_start(settings.seed))
    arguments = {
        "type": TYPE,
        "robots": f"[{{name: {ROBOT}, type: ugv_tags, pose: [{place}]}}]",
        "ugv_speed": settings.ugv_speed,
        "ugv_turn": settings.ugv_turn,
    }
    return directed_flight(settings, "landing.launch", arguments, _show_event, "landing_director")


def _show_event(event: dict[str, Any], display: Display) -> None:
    words = _WORDS.get(event["event"])
    if words is not None:
        display.note(f"  {event['time']:6.1f} s  {words}")


def robot_start(seed: int) -> tuple[float, float, float]:
    """Return where the robot starts, x, y, m, and yaw, rad: somewhere around the UAV, facing it roughly."""
    generator = random.Random(seed)
    bearing, aside = generator.uniform(-math.pi, math.pi), generator.uniform(-_ASIDE, _ASIDE)
    x, y = _SPAWN[0] + _AWAY * math.cos(bearing), _SPAWN[1] + _AWAY * math.sin(bearing)
    return round(x, 3), round(y, 3), round(math.remainder(bearing + math.pi + aside, math.tau), 4)
