"""``./xtdrone demo explore``: several UAVs explore a floor of rooms.

Exit status: 0 if the floor was explored without a collision, 1 if not, 2 for an invalid value, 128 + n when stopped by
signal n.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from rich.console import Console

from xtdrone_common.settings import setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError, seed_setting
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.launching.supervised_launch import Flight
from xtdrone_interaction.missions.demo import (
    DemoSettings,
    add_common_options,
    directed_flight,
    fly_directed,
    parse_start,
    show_landing,
    take_place,
)
from xtdrone_interaction.missions.solids import solids_of
from xtdrone_planning.exploration.settings import parse_bounds

if TYPE_CHECKING:
    from xtdrone_interaction.missions.mission import Mission

_HEIGHT = 1.5  # m
_APART = 2.0  # m between two vehicles at the start


@dataclass(frozen=True, kw_only=True)
class ExploreSettings(DemoSettings):
    """Settings of an exploration.

    Attributes:
        world: Name or file; see ``generated_world``.
    """

    n: int = setting(2, low=1, high=6, metavar="N", text="UAVs")
    length: float = setting(30.0, low=8.0, high=60.0, unit="m", metavar="M", text="length of the floor, along x")
    width: float = setting(20.0, low=6.0, high=60.0, unit="m", metavar="M", text="width of the floor, along y")
    delay: float = setting(0.0, low=0.0, high=1.0, unit="s", metavar="S", text="delay of the radio")
    loss: float = setting(0.0, low=0.0, high=0.5, metavar="PART", text="probability that a message by radio is lost")
    merge: bool = setting(False, text="merge the UAVs' maps through relative poses by UWB: merged_map.bt")
    speed_limit: float = setting(2.0, low=0.2, high=5.0, unit="m/s", metavar="M/S", text="greatest speed")
    bounds: tuple[float, float, float, float] | None = setting(
        None, parse=parse_bounds, unit="m", metavar="X0,Y0,X1,Y1",
        text="floor to explore, in map (default: the building of --length and --width)",
    )  # fmt: skip
    time_limit: float = setting(
        600.0, low=10.0, high=3600.0, unit="s", metavar="S", text="simulated time after which the UAVs land"
    )
    seed: int = seed_setting("seed of the building and of all noise")
    start: tuple[float, float] = setting(
        (17.0, 5.0), parse=parse_start, metavar="X,Y",
        text="middle of the UAVs' starts, m in map (default: 17,5, before the entrance of the building)",
    )  # fmt: skip

    @property
    def fleet(self) -> str:
        """The vehicles, as /xtdrone/fleet has them."""
        return f"{'iris_3d_lidar_uwb' if self.merge else 'iris_3d_lidar'}:{self.n}"

    @property
    def generated_world(self) -> str:
        """The building generated from the seed."""
        return f"indoor:seed={self.seed},length={self.length:g},width={self.width:g},door=1.5,corridor=2.4"

    @property
    def floor(self) -> tuple[float, float, float, float]:
        """The bounds x0, y0, x1, y1, m in map; by default those of the generated building."""
        if self.bounds is not None:
            return self.bounds
        from xtdrone_worlds.worlds.catalogue import load_world

        solids, _ = solids_of([model for model in load_world(self.world).models if model.name == "walls"])
        x = [solid.pose.position[0] for solid in solids] or [20.0, 20.0 + self.length]
        y = [solid.pose.position[1] for solid in solids] or [5.0 - self.width / 2, 5.0 + self.width / 2]
        return round(min(x), 3), round(min(y), 3), round(max(x), 3), round(max(y), 3)

    @property
    def starts(self) -> list[tuple[float, float]]:
        """Start of each vehicle, x, y, m in map."""
        return [(self.start[0], self.start[1] + _APART * (k - 0.5 * (self.n - 1))) for k in range(self.n)]

    def stored(self, begin: float) -> dict[str, Any]:
        """Return the settings stored in the report."""
        own = {"bounds": list(self.floor), "start": list(self.starts[0]), "fleet": self.fleet}
        return {**super().stored(begin), **own}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Explore a floor of rooms with several UAVs: each maps what its lidar sees, flies to the frontiers of known "
        "space, and shares its map and regions with the others, until the floor is explored. Leaves runs/<time>/ with "
        "flight.bag, report.html, report.json and floor.png."
    )
    options = ("n", "length", "width", "delay", "loss", "merge", "speed_limit", "start", "bounds", "time_limit")
    ExploreSettings.add_arguments(parser, options)
    world = "another world, by name or file (default: a building generated from the seed)"
    add_common_options(parser, ExploreSettings, world)


def settings_of(arguments: argparse.Namespace) -> ExploreSettings:
    """Return the settings of the flight, validated as far as possible without ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    settings = ExploreSettings.from_arguments(arguments, world="")
    if settings.merge and settings.n < 2:
        raise OptionError(f"n: {settings.n} is not allowed with --merge, 2 to 6")
    settings = replace(settings, world=command_options.world(arguments.world or settings.generated_world))
    return take_place(settings, arguments, settings.fleet)


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status."""
    return run_reported(lambda: fly(settings_of(arguments), PatientConsole()))


def fly(settings: ExploreSettings, console: Console) -> int:
    """Fly and return the exit status."""
    return fly_directed(load_mission, flight(settings), settings, console)


def load_mission() -> Mission:
    """Return the kind of the flight."""
    from xtdrone_interaction.missions.exploration.report import ExplorationMission  # imports Matplotlib, which is slow

    return ExplorationMission()


def flight(settings: ExploreSettings) -> Flight:
    """Return the launch file with its arguments."""
    arguments = {
        "vehicles": settings.fleet,
        "poses": f"[{','.join(f'[{x:g},{y:g}]' for x, y in settings.starts)}]",
        "homes": f"[{','.join(f'[{x:g},{y:g},{_HEIGHT:g}]' for x, y in settings.starts)}]",
        "bounds": ",".join(f"{value:g}" for value in settings.floor),
        **({"delay": settings.delay, "loss": settings.loss} if settings.n > 1 else {}),
        **({"merging": "true"} if settings.merge else {}),
        "speed_limit": settings.speed_limit,
        "time_limit": settings.time_limit,
        "octomap": settings.out / "map.bt",
    }
    return directed_flight(settings, "explore.launch", arguments, show_landing, "crossing_director")
