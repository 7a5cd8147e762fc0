"""Explore a floor: run launch/explore.launch, show its progress, and write the report and the picture of the floor."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_control.files import write_whole
from xtdrone_control.fleet import parse_fleet
from xtdrone_control.programs.node_command_line import speed_setting
from xtdrone_control.settings import Settings, setting
from xtdrone_interaction.command_options import seed_setting, web_setting
from xtdrone_interaction.demos.directed_flight import directed_flight, planning_times, show_landing, stored_settings
from xtdrone_interaction.launching.supervised_launch import DemoError, Flight, run_flight
from xtdrone_interaction.metrics.clearance import Solid, solids_of
from xtdrone_interaction.metrics.missions.formation_metrics import write_report
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.printed_results import print_exploration, print_paths
from xtdrone_interaction.report.report_tables import map_table, print_table
from xtdrone_planning.exploration.settings import ExplorationSettings, parse_bounds

_HEIGHT = 1.5  # m
_START = (17.0, 5.0)  # before the entrance of generated buildings and mazes
_APART = 2.0  # m between two vehicles at the start
_SETTINGS = "explore.json"  # in the results folder, to regenerate the report
_OCTREE = "map.bt"  # of several vehicles: map.VEHICLE.bt
_RESULTS = ("flight.bag", "report.json", "floor.png", "merged_map.png")


@dataclass(frozen=True, kw_only=True)
class ExploreDemoSettings(Settings):
    """Settings of an exploration.

    Attributes:
        world: name or file; see ``generated_world``.
        out: folder of the results.
        master_port: TCP port of the flight's own ROS master; 0: use the running one of ROS_MASTER_URI.
        instance: number of the simulation on this machine.
    """

    n: int = setting(2, low=1, high=6, metavar="N", text="UAVs")
    length: float = setting(30.0, low=8.0, high=60.0, unit="m", metavar="M", text="length of the floor, along x")
    width: float = setting(20.0, low=6.0, high=60.0, unit="m", metavar="M", text="width of the floor, along y")
    delay: float = setting(0.0, low=0.0, high=1.0, unit="s", metavar="S", text="delay of the radio")
    loss: float = setting(0.0, low=0.0, high=0.5, metavar="PART", text="probability that a message by radio is lost")
    merge: bool = setting(False, text="merge the UAVs' maps through relative poses by UWB: merged_map.bt")
    speed_limit: float = setting(2.0, low=0.2, high=5.0, unit="m/s", metavar="M/S", text="greatest speed")
    world: str = ""
    bounds: tuple[float, float, float, float] | None = setting(
        None, parse=parse_bounds, unit="m", metavar="X0,Y0,X1,Y1",
        text="floor to explore, in map (default: the building of --length and --width)",
    )  # fmt: skip
    time_limit: float = setting(
        600.0, low=10.0, high=3600.0, unit="s", metavar="S", text="simulated time after which the UAVs land"
    )
    seed: int = seed_setting("seed of the building and of all noise")
    speed: float = speed_setting()
    out: Path = Path()
    master_port: int = 0
    headless: bool = setting(False, text="no live display; print a progress line every few seconds")
    instance: int = 0
    web: bool = web_setting()

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
        from xtdrone_sim.worlds.catalogue import load_world  # slow to import

        walls = [model for model in load_world(self.world).models if model.name == "walls"]
        solids, _ = solids_of(walls)
        x = [solid.pose.position[0] for solid in solids] or [20.0, 20.0 + self.length]
        y = [solid.pose.position[1] for solid in solids] or [5.0 - self.width / 2, 5.0 + self.width / 2]
        return round(min(x), 3), round(min(y), 3), round(max(x), 3), round(max(y), 3)

    @property
    def starts(self) -> list[tuple[float, float]]:
        """Start of each vehicle, x, y, m in map."""
        return [(_START[0], _START[1] + _APART * (k - 0.5 * (self.n - 1))) for k in range(self.n)]

    def stored(self) -> dict[str, Any]:
        """Return the settings stored in the report."""
        unstored = ("out", "master_port", "headless", "instance", "web")
        stored = {key: value for key, value in asdict(self).items() if key not in unstored}
        return {**stored, "bounds": list(self.floor), "start": list(self.starts[0]), "fleet": self.fleet}


def run_explore(settings: ExploreDemoSettings, console: Console) -> int:
    """Fly.

    Returns:
        The exit status: 0 if the floor was explored without a collision, 1 if not, 128 + signal when stopped.
    """
    begin = time.monotonic()

    def conclude(_: object) -> int:
        stored = {**settings.stored(), "wall_time": time.monotonic() - begin}
        write_whole(settings.out / _SETTINGS, json.dumps(stored, indent=2) + "\n")
        return _report(settings.out, stored, console)

    return run_flight(flight(settings), console, conclude)


def flight(settings: ExploreDemoSettings) -> Flight:
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
        "octomap": settings.out / _OCTREE,
    }
    return directed_flight(settings, "explore.launch", arguments, show_landing)


def is_exploration(folder: Path) -> bool:
    """Return whether a results folder is that of an exploration."""
    return (folder / _SETTINGS).is_file()


def report_again(bag: Path, console: Console) -> int:
    """Regenerate report and picture of a recorded exploration; return the exit status.

    Raises:
        DemoError: it cannot be read.
    """
    return _report(bag.parent, stored_settings(bag.parent / _SETTINGS), console)


def unsaved_maps(folder: Path, names: Sequence[str]) -> list[str]:
    """Return the octrees that should be in the results folder of some vehicles and are not."""
    expected = [_OCTREE] if len(names) == 1 else [_OCTREE.replace(".", f".{name}.") for name in names]
    return [name for name in expected if not (folder / name).is_file()]


def _add_merging(report: dict[str, Any], folder: Path, names: Sequence[str], solids: Sequence[Solid]) -> None:
    """Add the state of map merging to a report, and draw the merged map if there is one.

    Raises:
        DemoError: the record or a map cannot be read.
    """
    from xtdrone_interaction.metrics.missions.map_report import MERGED, octrees_in, read_map
    from xtdrone_interaction.pictures.missions.merged_map_picture import (
        save_merged_map,  # matplotlib takes a while to import
    )
    from xtdrone_interaction.recording.missions.merging_record import read_merging

    try:
        report["merging"] = read_merging(folder / "flight.bag", names)
        saved = {path: read_map(path) for path in octrees_in(folder)}
    except RecordError as error:
        raise DemoError(str(error)) from error
    apart = [f"{name}: {entry['state']}" for name, entry in report["merging"].items() if not entry["merged"]]
    if not report["merging"]:
        apart = ["map_merging.py has reported nothing"]
    report["shortcomings"] += apart
    merged = [points for path, points in saved.items() if path.stem == MERGED]
    single = {path.suffixes[0].strip("."): points for path, points in saved.items() if path.stem != MERGED}
    if merged and len(merged[0]):
        save_merged_map(single, merged[0], solids, folder / "merged_map.png")


def _report(folder: Path, settings: Mapping[str, Any], console: Console) -> int:
    """Write report.json and floor.png, print the figures, and return the exit status.

    Raises:
        DemoError: the bag is not a record of such a flight.
    """
    from xtdrone_interaction.metrics.missions.exploration_metrics import make_report, visible_cells
    from xtdrone_interaction.metrics.missions.map_report import map_rows, octrees_in
    from xtdrone_interaction.pictures.missions.exploration_picture import (
        save_floor,  # matplotlib takes a while to import
    )
    from xtdrone_interaction.recording.missions.exploration_record import read_exploration
    from xtdrone_sim.worlds.catalogue import load_world

    try:
        names = [vehicle.name for vehicle in parse_fleet(str(settings["fleet"]))]
        record = read_exploration(folder / "flight.bag", names)
        solids, _ = solids_of(load_world(str(settings["world"])).models)
        exploration = ExplorationSettings(bounds=tuple(settings["bounds"]))
        maps = map_rows([folder / "flight.bag"], str(settings["world"]), octrees_in(folder))
        visible, solid = visible_cells(solids, exploration, tuple(settings["start"]))
    except (RecordError, ValueError, KeyError) as error:
        raise DemoError(str(error)) from error
    report = make_report(record, solids, visible, settings, planning_times(folder))
    report["maps"] = maps
    report["shortcomings"] += [f"{name} was not saved" for name in unsaved_maps(folder, names)]
    if settings.get("merge"):
        _add_merging(report, folder, names, solids)
    print_exploration(report, console)  # first: the disk may be full
    if maps:
        print_table(map_table(maps), console)
    write_report(report, folder / "report.json")
    save_floor(record, visible, solid, exploration, report, folder / "floor.png")
    results = [folder / name for name in _RESULTS if (folder / name).exists()]
    print_paths([*results, *octrees_in(folder)], console)
    return 1 if report["shortcomings"] else 0
