"""``./xtdrone demo slam``: one vehicle flies without GPS, by lidar, camera or 2D laser alone.

Exit status: 0 for a flight that came home, 1 if the script or the launch has failed or it landed elsewhere, 2 for an
invalid value, 128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from xtdrone_control.programs.node_command_line import speed_setting
from xtdrone_control.settings import Settings, setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import MachineSettings, OptionError, seed_setting, web_setting
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.launching.flown_script import fly_script
from xtdrone_interaction.launching.supervised_launch import DemoError, Launch, master_port, run_launch, watching
from xtdrone_interaction.metrics.missions.formation_metrics import write_report
from xtdrone_interaction.metrics.missions.slam_report import slam_report
from xtdrone_interaction.monitoring.ended_nodes import EndedNodes
from xtdrone_interaction.recording.recorded_flight import RecordError
from xtdrone_interaction.report.report_tables import map_table, odometry_table, print_table

TYPES = {"lidar": "iris_slam", "rgbd": "iris_slam_rgbd", "stereo": "iris_slam_stereo", "laser": "iris_slam_laser"}
SCRIPT = command_options.repository() / "src" / "xtdrone_control" / "examples" / "slam.py"
_WORLDS = {"lidar": "city", "rgbd": "outdoor", "stereo": "outdoor", "laser": "indoor"}
_WAYS = {
    "lidar": (),
    "rgbd": ("4,0", "4,3", "0,3"),
    "stereo": ("4,0", "4,3", "0,3"),
    "laser": ("15,0",),
}
"""Default paths; the script has that of the lidar. Cameras look ahead, at the scenery in the east."""
_POSES = {"laser": "[22, 5, 0, 0, 0, 0]"}  # inside the building
_WESTERN = re.compile(r"-[\d.]+,")
_RESULTS = ("flight.bag", "report.json", "path.png", "drift.png", "map.bt")


@dataclass(frozen=True, kw_only=True)
class SlamSettings(Settings):
    """Settings of the flight.

    Attributes:
        script: the file that flies the vehicle.
        odometry: its sensor, one of ``TYPES``.
        way: its arguments: points east, north of the start.
        world: name, or absolute path of a file.
        out: folder of the results.
        master_port: TCP port of the flight's own ROS master.
        instance: number of the simulation on this machine.
    """

    script: Path
    odometry: str
    way: tuple[str, ...] = ()
    world: str
    height: float = setting(3.0, low=1.0, high=50.0, unit="m", text="height of the flight above the start")
    speed: float = speed_setting()
    seed: int = seed_setting()
    web: bool = web_setting()
    out: Path
    master_port: int
    instance: int


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly one vehicle along a path, back home and down without GPS, by lidar or camera odometry. Leaves "
        "runs/<time>/ with flight.bag, report.json, and pictures of the path over the map and of the drift."
    )
    parser.add_argument("--script", type=Path, default=SCRIPT, metavar="FILE.py", help="script that flies the vehicle")
    parser.add_argument("--by", choices=tuple(TYPES), default="lidar", help="sensor of the odometry (default: lidar)")
    parser.add_argument(
        "--way", nargs="+", default=[], metavar="X,Y", help="waypoints of the path, m east and north of the start"
    )
    SlamSettings.add_arguments(parser, ("height", "speed", "seed", "web"))
    parser.add_argument(
        "--world",
        metavar="WORLD",
        help="world, by name or file (default: city; outdoor for cameras, indoor for a laser)",
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    MachineSettings.add_arguments(parser, ("master_port",))
    command_options.add_instance(parser)


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Parse the options; argparse alone takes a point in the west, as -5,3, for an option."""
    return parser.parse_args([f" {word}" if _WESTERN.match(word) else word for word in words])


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status."""
    return run_reported(lambda: _fly(_settings(arguments), PatientConsole()))


def _settings(arguments: argparse.Namespace) -> SlamSettings:
    """Return the settings, after all checks that need no ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    script: Path = arguments.script
    if script.suffix != ".py" or not script.is_file():
        raise OptionError(f"script: {str(script)!r} is not allowed, an existing .py file")
    for point in arguments.way:
        _check_point(point)
    machine = MachineSettings.from_arguments(arguments)
    return SlamSettings.from_arguments(
        arguments,
        script=script.resolve(),
        odometry=arguments.by,
        way=tuple(point.strip() for point in arguments.way) or _WAYS[arguments.by],
        world=command_options.world(arguments.world or _WORLDS[arguments.by]),
        out=command_options.results_folder(arguments.out, recorded=True),
        master_port=master_port(machine.master_port, use_running=False),
        instance=command_options.take_instance(f"{TYPES[arguments.by]}:1", machine.instance),
    )


def _check_point(text: str) -> None:
    try:
        east, north = (float(part) for part in text.split(","))
    except ValueError:
        east = north = float("nan")
    if not (abs(east) <= 1e4 and abs(north) <= 1e4):
        raise OptionError(f"way: {text.strip()!r} is not allowed; two comma-separated numbers in m, e.g. 20,-5")


def _fly(settings: SlamSettings, console: Console) -> int:
    launch = Launch(
        "slam.launch",
        {
            "odometry": settings.odometry,
            "type": TYPES[settings.odometry],
            "world": settings.world,
            **({"pose": _POSES[settings.odometry]} if settings.odometry in _POSES else {}),
            "speed": settings.speed,
            "seed": settings.seed,
            "bag": settings.out / "flight.bag",
            **({"octomap": settings.out / "map.bt"} if settings.odometry == "lidar" else {}),
            **({"instance": settings.instance} if settings.instance else {}),
            **({"web": "true"} if settings.web else {}),
        },
        settings.out,
        settings.master_port,
        headless=True,
        instance=settings.instance,
    )
    command: list[Path | str] = [settings.script, f"{TYPES[settings.odometry]}_0", str(settings.height), *settings.way]

    def go() -> int:
        ended_nodes = EndedNodes(launch.log)
        with watching(launch, console, ended_nodes, {}) as watch:
            status = fly_script(command, launch, watch)
        if status:
            raise DemoError(f"{settings.script.name} has ended with status {status}")
        return 0

    status = run_launch(launch, console, go)
    flown = {"world": settings.world, "seed": settings.seed, "height": settings.height, "way": list(settings.way)}
    return status or report_again(settings.out / "flight.bag", console, flown)


def is_slam(folder: Path) -> bool:
    """Return whether the report in a results folder is that of a flight by odometry."""
    try:
        return "odometry" in json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return False


def _stored_settings(folder: Path) -> dict[str, Any]:
    """Return the settings of the report that is made again; empty without one."""
    try:
        return dict(json.loads((folder / "report.json").read_text(encoding="utf-8"))["settings"])
    except (OSError, ValueError, TypeError, KeyError):
        return {}


def report_again(bag: Path, console: Console, settings: dict[str, Any] | None = None) -> int:
    """Write report and pictures beside a bag, print the figures, and return the exit status.

    Raises:
        DemoError: the bag is not a record of such a flight.
    """
    from xtdrone_interaction.pictures.odometry_pictures import save_pictures  # imports matplotlib, which is slow

    settings = settings or _stored_settings(bag.parent)
    try:
        report, shown = slam_report(bag, settings.get("world"))
    except RecordError as error:
        raise DemoError(str(error)) from error
    report["settings"] = settings
    print_table(odometry_table(report["odometry"]), console)  # first: the disk may be full
    if report["maps"]:
        print_table(map_table(report["maps"]), console)
    console.print(f"landed {report['home_miss']:.2f} m from the start", highlight=False)
    write_report(report, bag.parent / "report.json")
    save_pictures(shown, bag.parent)
    for name in _RESULTS:
        if (bag.parent / name).exists():
            console.print(f"  {bag.parent / name}", highlight=False, soft_wrap=True)
    for text in report["shortcomings"]:
        console.print(f"[red]{text}[/red]", highlight=False, soft_wrap=True)
    return 1 if report["shortcomings"] else 0
