"""Fly through a forest: run launch/forest.launch, show its progress, and write the report and the map."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from xtdrone_control.files import write_whole
from xtdrone_control.fleet import parse_fleet
from xtdrone_control.programs.node_command_line import speed_setting
from xtdrone_control.settings import Settings, setting
from xtdrone_interaction.command_options import seed_setting, web_setting
from xtdrone_interaction.demos.directed_flight import directed_flight, planning_times, show_landing, stored_settings
from xtdrone_interaction.launching.supervised_launch import DemoError, Flight, escape, run_flight
from xtdrone_interaction.metrics.clearance import Solid, solids_of
from xtdrone_interaction.metrics.missions.crossing_metrics import make_report
from xtdrone_interaction.metrics.missions.formation_metrics import write_report
from xtdrone_interaction.recording.missions.crossing_record import CrossingRecord, read_crossing
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.printed_results import print_crossing, print_paths
from xtdrone_planning.planner_settings import GLOBAL_PLANNERS

_TYPES = {"lidar": "iris_3d_lidar", "depth": "iris_depth_camera"}
_HEIGHT = 2.0  # m
_APART = 4.0  # m between the lines of several UAVs
_ROW, _SPACING = 3, 3.0  # vehicles in a row behind the leader of a formation before takeoff, and m between them
_LENGTH, _FORMATION_LENGTH = 73, 68  # m of the forest: a formation's slots at the goal are beyond the trees
_SETTINGS = "forest.json"  # in the results folder, to regenerate the report
_RESULTS = ("flight.bag", "report.json", "map.png", "flight.mp4", "flight.gif")


def _numbers(text: object, counts: tuple[int, ...], example: str) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in str(text).split(","))
    except ValueError:
        values = ()
    if len(values) not in counts or not all(map(math.isfinite, values)):
        raise ValueError(f"{' or '.join(map(str, counts))} comma-separated numbers, e.g. {example}, m in map")
    return values


def _parse_start(text: object) -> tuple[float, ...]:
    return _numbers(text, (2,), "14,5")


def _parse_goal(text: object) -> tuple[float, ...]:
    values = _numbers(text, (2, 3), "65,5,2")
    return values if len(values) > 2 else (*values, _HEIGHT)


@dataclass(frozen=True, kw_only=True)
class ForestDemoSettings(Settings):
    """Settings of a flight through a forest.

    Attributes:
        world: name or file; see ``generated_world``.
        out: folder of the results.
        master_port: TCP port of the flight's own ROS master; 0: use the running one of ROS_MASTER_URI.
        instance: number of the simulation on this machine.
        film: whether to film the recorded flight afterwards.
    """

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
    world: str = ""
    start: tuple[float, float] = setting(
        (14.0, 5.0), parse=_parse_start, metavar="X,Y", text="start, m in map (default: 14,5)"
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
    speed: float = speed_setting()
    out: Path = Path()
    master_port: int = 0
    headless: bool = setting(False, text="no live display; print a progress line every few seconds")
    logs: bool = setting(False, text="write the vehicle's flight log (PX4's ULog)")
    instance: int = 0
    web: bool = web_setting()
    film: bool = False

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

    def stored(self) -> dict[str, Any]:
        """Return the settings stored in the report."""
        unstored = ("out", "master_port", "headless", "instance", "web", "film")
        stored = {key: value for key, value in asdict(self).items() if key not in unstored}
        return {**stored, "speed_limit": self.greatest_speed}


def run_forest(settings: ForestDemoSettings, console: Console) -> int:
    """Fly.

    Returns:
        The exit status: 0 if the UAV arrived without a collision, 1 if not, 128 + signal when stopped.
    """
    begin = time.monotonic()

    def conclude(_: object) -> int:
        stored = {**settings.stored(), "fleet": settings.fleet, "wall_time": time.monotonic() - begin}
        write_whole(settings.out / _SETTINGS, json.dumps(stored, indent=2) + "\n")
        status = _report(settings.out, stored, console)
        if settings.film:
            _film(*_record(settings.out, stored), settings.out, console)
        return status

    return run_flight(flight(settings), console, conclude)


def flight(settings: ForestDemoSettings) -> Flight:
    """Return the launch file with its arguments."""
    starts, goals = settings.routes()
    arguments = {
        "vehicles": settings.fleet,
        "sensor": settings.sensor,
        "planner": settings.planner,
        "poses": _listed(starts),
        "goals": _listed(goals),
        **({"delay": settings.delay, "loss": settings.loss} if settings.n > 1 else {}),
        **_formation_arguments(settings),
        "speed_limit": settings.greatest_speed,
        "acceleration_limit": settings.acceleration_limit,
        "highest": settings.highest,
        "time_limit": settings.time_limit,
        **({"log": settings.out / "ulog"} if settings.logs else {}),
    }
    return directed_flight(settings, "forest.launch", arguments, show_landing)


def _formation_arguments(settings: ForestDemoSettings) -> dict[str, Any]:
    if not settings.formation:
        return {}
    classes = {"follower_class": settings.follower_class, "leader_class": settings.leader_class}
    given = {name: value for name, value in classes.items() if value}
    return {"pattern": settings.formation, "follower_speed": 2.0 * settings.leader_speed, **given}


def _listed(places: Sequence[Sequence[float]]) -> str:
    return f"[{','.join('[' + ','.join(f'{value:g}' for value in place) + ']' for place in places)}]"


def is_forest(folder: Path) -> bool:
    """Return whether a results folder is that of a flight through a forest."""
    return (folder / _SETTINGS).is_file()


def report_again(bag: Path, console: Console) -> int:
    """Regenerate report and map of a recorded flight; return the exit status.

    Raises:
        DemoError: it cannot be read.
    """
    return _report(bag.parent, stored_settings(bag.parent / _SETTINGS), console)


def _report(folder: Path, settings: Mapping[str, Any], console: Console) -> int:
    """Write report.json and map.png, print the figures, and return the exit status.

    Raises:
        DemoError: the bag is not a record of such a flight.
    """
    from xtdrone_interaction.pictures.missions.crossing_map import (
        save_crossing_map,  # matplotlib takes a while to import
    )

    record, solids = _record(folder, settings)
    report = make_report(record, solids, settings, planning_times(folder))
    print_crossing(report, console)  # first: the disk may be full
    write_report(report, folder / "report.json")
    save_crossing_map(record, solids, folder / "map.png")
    print_paths((folder / name for name in _RESULTS if (folder / name).exists()), console)
    return 1 if report["shortcomings"] else 0


def _record(folder: Path, settings: Mapping[str, Any]) -> tuple[CrossingRecord, list[Solid]]:
    """Return the record of a flight, and the obstacles of its world.

    Raises:
        DemoError: the bag is not a record of such a flight.
    """
    from xtdrone_sim.worlds.catalogue import load_world

    try:
        names = [vehicle.name for vehicle in parse_fleet(str(settings["fleet"]))]
        record = read_crossing(folder / "flight.bag", names)
        solids, _ = solids_of(load_world(str(settings["world"])).models)
    except (RecordError, ValueError) as error:
        raise DemoError(str(error)) from error
    return record, list(solids)


def _film(record: CrossingRecord, solids: Sequence[Solid], folder: Path, console: Console) -> None:
    """Film the flight beside its bag; print the path, or why there is no film."""
    from xtdrone_interaction.pictures.missions.crossing_film import save_crossing_film  # imports Matplotlib
    from xtdrone_interaction.pictures.missions.formation_film import default_file
    from xtdrone_swarm.view import FilmError

    try:
        print_paths([save_crossing_film(record, solids, default_file(folder))], console)
    except FilmError as error:
        console.print(f"[yellow]no film:[/yellow] {escape(str(error))}", highlight=False, soft_wrap=True)
