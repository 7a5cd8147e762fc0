"""``./xtdrone demo slam``: one vehicle flies without GPS, by lidar, camera or 2D laser alone.

Exit status: 0 for a flight that came home, 1 if the script or the launch has failed or it landed elsewhere, 2 for an
invalid value, 128 + n when stopped by signal n.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from xtdrone_common.settings import setting
from xtdrone_interaction import command_options
from xtdrone_interaction.command_options import OptionError
from xtdrone_interaction.console import PatientConsole, run_reported
from xtdrone_interaction.missions.demo import (
    BAG,
    DemoSettings,
    add_common_options,
    check_script,
    fly_scripted,
    scripted_launch,
    take_place,
)

if TYPE_CHECKING:
    from xtdrone_interaction.missions.mission import Mission

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


@dataclass(frozen=True, kw_only=True)
class SlamSettings(DemoSettings):
    """Settings of the flight.

    Attributes:
        script: File that flies the vehicle.
        odometry: Its sensor, one of ``TYPES``.
        way: Its arguments: points east, north of the start.
    """

    UNSTORED = (*DemoSettings.UNSTORED, "script", "odometry", "speed", "logs")

    script: Path
    odometry: str
    way: tuple[str, ...] = ()
    height: float = setting(3.0, low=1.0, high=50.0, unit="m", text="height of the flight above the start")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly one vehicle along a path, back home and down without GPS, by lidar or camera odometry. Leaves "
        "runs/<time>/ with flight.bag, report.html, report.json, and pictures of the path over the map and of the "
        "drift."
    )
    parser.add_argument("--script", type=Path, default=SCRIPT, metavar="FILE.py", help="script that flies the vehicle")
    parser.add_argument("--by", choices=tuple(TYPES), default="lidar", help="sensor of the odometry (default: lidar)")
    parser.add_argument(
        "--way", nargs="+", default=[], metavar="X,Y", help="waypoints of the path, m east and north of the start"
    )
    SlamSettings.add_arguments(parser, ("height",))
    world = "world, by name or file (default: city; outdoor for cameras, indoor for a laser)"
    add_common_options(parser, SlamSettings, world)


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """Parse the options; argparse alone takes a point in the west, as -5,3, for an option."""
    return parser.parse_args([f" {word}" if _WESTERN.match(word) else word for word in words])


def run(arguments: argparse.Namespace) -> int:
    """Fly and return the exit status."""
    return run_reported(lambda: fly(settings_of(arguments), PatientConsole()))


def settings_of(arguments: argparse.Namespace) -> SlamSettings:
    """Return the settings, after all checks that need no ROS.

    Raises:
        OptionError: a value is not allowed.
    """
    script = check_script(arguments.script)
    for point in arguments.way:
        _check_point(point)
    settings = SlamSettings.from_arguments(
        arguments,
        script=script,
        odometry=arguments.by,
        way=tuple(point.strip() for point in arguments.way) or _WAYS[arguments.by],
        world=command_options.world(arguments.world or _WORLDS[arguments.by]),
    )
    return take_place(settings, arguments, f"{TYPES[arguments.by]}:1")


def _check_point(text: str) -> None:
    try:
        east, north = (float(part) for part in text.split(","))
    except ValueError:
        east = north = float("nan")
    if not (abs(east) <= 1e4 and abs(north) <= 1e4):
        raise OptionError(f"way: {text.strip()!r} is not allowed; two comma-separated numbers in m, e.g. 20,-5")


def fly(settings: SlamSettings, console: Console) -> int:
    """Fly and return the exit status."""
    vehicle_type = TYPES[settings.odometry]
    arguments = {
        "odometry": settings.odometry,
        "type": vehicle_type,
        **({"pose": _POSES[settings.odometry]} if settings.odometry in _POSES else {}),
        "bag": settings.out / BAG,
        **({"octomap": settings.out / "map.bt"} if settings.odometry == "lidar" else {}),
    }
    launch = scripted_launch(settings, "slam.launch", arguments)
    command: list[Path | str] = [settings.script, f"{vehicle_type}_0", str(settings.height), *settings.way]
    return fly_scripted(load_mission, launch, command, settings, console)


def load_mission() -> Mission:
    """Return the kind of the flight."""
    from xtdrone_interaction.missions.slam.report import SlamMission  # imports Matplotlib, which is slow

    return SlamMission()
