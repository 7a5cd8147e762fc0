"""``./xtdrone demo forest``: a flight through a forest, alone, in pairs or in formation.

Exit status: 0 if all UAVs arrived without a collision, 1 if not, 2 for an invalid value, 128 + n when stopped by
signal n.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from xtdrone_common.settings import setting
from xtdrone_coordination.follower import Follower
from xtdrone_coordination.leader import Leader
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError, seed_setting
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.launching.supervised_launch import Flight
from xtdrone_interaction.missions.demo import (
    DemoSettings,
    add_common_options,
    directed_flight,
    fly_directed,
    parse_numbers,
    parse_start,
    show_landing,
    take_place,
)
from xtdrone_planning.planner_settings import GLOBAL_PLANNERS, PlannerSettings

if TYPE_CHECKING:
    from xtdrone_interaction.missions.mission import Mission

_TYPES = {"lidar": "iris_3d_lidar", "depth": "iris_depth_camera"}
_HEIGHT = 2.0  # m
_APART = 4.0  # m between the lines of several UAVs
_ROW, _SPACING = 3, 3.0  # vehicles in a row behind the leader of a formation before takeoff, and m between them
_LENGTH, _FORMATION_LENGTH = 73, 68  # m of the forest: a formation's slots at the goal are beyond the trees


def _parse_goal(text: object) -> tuple[float, ...]:
    values = parse_numbers(text, (2, 3), "65,5,2")
    return values if len(values) > 2 else (*values, _HEIGHT)


@dataclass(frozen=True, kw_only=True)
class ForestSettings(DemoSettings):
    """Settings of a flight through a forest.

    Attributes:
        world: Name or file; see ``generated_world``.
        follower_class, leader_class: The user's classes for a formation, ``/absolute/file.py[:Class]``, or empty.
    """

    UNSTORED = (*DemoSettings.UNSTORED, "film")

    sensor: str = setting("lidar", choices=tuple(_TYPES), text="sensor of the UAV")
    planner: str = setting("astar", choices=GLOBAL_PLANNERS, text="search for the path: A*, or OMPL's")
    n: int = setting(1, low=1, high=12, metavar="N", text="number of UAVs; several swap sides in pairs")
    delay: float = setting(
        0.0, low=0.0, high=2.0, unit="s", metavar="S", text="delay of the radio between several UAVs"
    )
    loss: float = setting(0.0, low=0.0, high=0.5, metavar="PART", text="probability that a message by radio is lost")
    formation: str = setting(
        "", metavar="PATTERN", text="follow the first UAV in this formation, e.g. circle or grid:spacing=4; needs --n"
    )
    follower_class: str = ""
    leader_class: str = ""
    leader_speed: float = setting(
        1.5, low=0.2, high=3.0, unit="m/s", metavar="M/S", text="maximum speed of a formation's leader"
    )
    speed_limit: float = setting(4.5, low=0.2, high=15.0, unit="m/s", metavar="M/S", text="greatest speed")
    acceleration_limit: float = setting(
        3.0, low=0.3, high=8.0, unit="m/s²", metavar="M/S2", text="greatest acceleration"
    )
    density: float = setting(0.1, low=0.01, high=0.2, unit="1/m²", metavar="D", text="trees per square metre")
    start: tuple[float, float] = setting(
        (14.0, 5.0), parse=parse_start, metavar="X,Y", text="start, m in map (default: 14,5)"
    )
    goal: tuple[float, float, float] = setting(
        (65.0, 5.0, _HEIGHT), parse=_parse_goal, metavar="X,Y[,Z]", text="goal, m in map (default: 65,5,2)"
    )
    highest: float = setting(
        5.0, low=1.0, high=100.0, unit="m", metavar="M", text="maximum height of flight; higher walls are flown around"
    )
    time_limit: float = setting(
        180.0, low=10.0, high=3600.0, unit="s", metavar="S", text="simulated time after which the UAV lands where it is"
    )
    seed: int = seed_setting("seed of the forest and of all noise")
    film: bool = setting(True, text="no film of the flight, flight.mp4, after its end")

    @property
    def fleet(self) -> str:
        """The vehicles, as /xtdrone/fleet has them."""
        return f"{_TYPES[self.sensor]}:{self.n}"

    @property
    def greatest_speed(self) -> float:
        """Speed limit of the vehicles that fly to a goal, m/s."""
        return self.leader_speed if self.formation else self.speed_limit

    @property
    def generated_world(self) -> str:
        """The generated forest: bare trunks on 40 x 40 m between start and goal."""
        length = _FORMATION_LENGTH if self.formation else _LENGTH
        return f"forest:seed={self.seed},density={self.density:g},length={length},width=40,trunks=true"

    def routes(self) -> tuple[list[tuple[float, ...]], list[tuple[float, ...]]]:
        """Return starts (x, y) and goals (x, y, z), m in map.

        A formation starts behind its leader, whose goal is the only one used. Otherwise, UAVs start in pairs on
        parallel lines from start to goal; the two of a pair swap positions.
        """
        if self.n == 1:
            return [self.start], [self.goal]
        if self.formation:
            return self._rows(), [self.goal] * self.n
        start, goal = np.array([*self.start, self.goal[2]]), np.array(self.goal)
        along = (goal - start)[:2] / max(float(np.linalg.norm((goal - start)[:2])), 1e-9)
        starts, goals = [], []
        pairs = (self.n + 1) // 2
        for k in range(self.n):
            aside = (k // 2 - 0.5 * (pairs - 1)) * _APART * np.array([-along[1], along[0], 0.0])
            here, there = (start, goal) if k % 2 == 0 else (goal, start)
            starts.append(tuple(map(float, (here + aside)[:2])))
            goals.append(tuple(map(float, there + aside)))
        return starts, goals

    def _rows(self) -> list[tuple[float, ...]]:
        """Return the starts of a formation, x and y, m: the leader, and the others in rows behind it."""
        x, y = self.start
        places = [divmod(k, _ROW) for k in range(self.n - 1)]
        behind = [(x - _SPACING * (row + 1), y + _SPACING * (column - (_ROW - 1) / 2)) for row, column in places]
        return [self.start, *behind]

    def stored(self, begin: float) -> dict[str, Any]:
        """Return the settings stored in the report."""
        return {**super().stored(begin), "speed_limit": self.greatest_speed, "fleet": self.fleet}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly a UAV through an unknown forest, by lidar or depth camera: it maps what it sees, plans a smooth "
        "trajectory and replans as it sees more. With --formation several UAVs cross it behind their leader, "
        "and re-form. Leaves runs/<time>/ with flight.bag, report.html, report.json, map.png and a film."
    )
    settings = ForestSettings.add_arguments
    settings(parser, ("n", "sensor", "planner", "delay", "loss", "speed_limit", "acceleration_limit", "density"))
    settings(parser, ("formation", "leader_speed"))
    parser.add_argument(
        "--follower", metavar="FILE.py[:CLASS]",
        help="your own follower class (default: the example ForestFollower, which keeps up with the leader)",
    )  # fmt: skip
    parser.add_argument("--leader", metavar="FILE.py:CLASS", help="your own leader class (default: the shipped one)")
    settings(parser, ("start", "goal", "highest", "time_limit", "film"))
    world = "another world, by name or file (default: a forest generated from the seed)"
    add_common_options(parser, ForestSettings, world)


def settings_of(arguments: argparse.Namespace) -> ForestSettings:
    """Return the settings of the flight, validated as far as possible without ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    settings = ForestSettings.from_arguments(arguments, world="")
    settings = replace(settings, world=command_options.world(arguments.world or settings.generated_world))
    settings = replace(
        settings,
        follower_class=command_options.follower_class(arguments.follower),
        leader_class=command_options.leader_class(arguments.leader),
    )
    _check_formation(settings)
    return take_place(settings, arguments, settings.fleet)


def _check_formation(settings: ForestSettings) -> None:
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
    """Fly and return the exit status."""
    return run_reported(lambda: fly(settings_of(arguments), PatientConsole()))


def fly(settings: ForestSettings, console: Console) -> int:
    """Fly and return the exit status."""
    return fly_directed(load_mission, flight(settings), settings, console, film=settings.film)


def load_mission() -> Mission:
    """Return the kind of the flight."""
    from xtdrone_interaction.missions.crossing.report import CrossingMission  # imports Matplotlib, which is slow

    return CrossingMission()


def flight(settings: ForestSettings) -> Flight:
    """Return the launch file with its arguments."""
    starts, goals = settings.routes()
    arguments = {
        "vehicles": settings.fleet,
        "sensor": settings.sensor,
        "planner": settings.planner,
        "poses": _format_places(starts),
        "goals": _format_places(goals),
        **({"delay": settings.delay, "loss": settings.loss} if settings.n > 1 else {}),
        **_formation_arguments(settings),
        "speed_limit": settings.greatest_speed,
        "acceleration_limit": settings.acceleration_limit,
        "highest": settings.highest,
        "time_limit": settings.time_limit,
    }
    return directed_flight(settings, "forest.launch", arguments, show_landing, "crossing_director")


def _formation_arguments(settings: ForestSettings) -> dict[str, Any]:
    if not settings.formation:
        return {}
    classes = {"follower_class": settings.follower_class, "leader_class": settings.leader_class}
    given = {name: value for name, value in classes.items() if value}
    return {"pattern": settings.formation, "follower_speed": 2.0 * settings.leader_speed, **given}


def _format_places(places: Sequence[Sequence[float]]) -> str:
    return f"[{','.join('[' + ','.join(f'{value:g}' for value in place) + ']' for place in places)}]"
