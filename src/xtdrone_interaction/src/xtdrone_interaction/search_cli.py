"""``./xtdrone demo search``: its options and their checks."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from xtdrone_control.fleet import parse_fleet
from xtdrone_interaction import options
from xtdrone_interaction.launched import master_port
from xtdrone_interaction.options import OptionError, checked
from xtdrone_interaction.screen import PatientConsole, run_reported
from xtdrone_interaction.search_demo import run_search
from xtdrone_interaction.search_prepare import SearchSettings

_HEIGHTS = (6.0, 25.0)  # m, for which the detector was trained
_MAX_VEHICLES = 12  # their height steps stay within these heights
_MAX_PERSONS = 20
_RATES = (0.5, 10.0)  # Hz


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.description = (
        "Fly the cooperative search: the region is divided, the ground station uploads the plans to the vehicles, "
        "detectors look for people, a find is inspected a second time and followed. Leaves runs/<time>/ with "
        "flight.bag, report.json, map.png, the views as pictures and film, the plans and the world."
    )
    add = parser.add_argument
    add("--n", type=checked(lambda text: whole("number of vehicles", text, 1, _MAX_VEHICLES)), default=6, metavar="N",
        help="number of vehicles (default: %(default)s)")  # fmt: skip
    add("--type", default="typhoon_h480", metavar="TYPE", help="vehicle type (default: %(default)s)")
    add("--seed", type=checked(options.seed), default=0, metavar="SEED",
        help="seed of the world, of the person's position, and of all noise (default: %(default)s)")  # fmt: skip
    add("--persons", type=checked(lambda text: whole("persons", text, 0, _MAX_PERSONS)), default=1, metavar="K",
        help="persons in the region (default: %(default)s)")  # fmt: skip
    add("--standing", action="store_true", help="standing persons (default: walking)")
    add("--region", type=Path, metavar="FILE",
        help="YAML file with region: [[x, y], ...] and holes: [...], m in map (default: the shipped one)")  # fmt: skip
    add("--plans", type=Path, metavar="FOLDER",
        help="your own VEHICLE.plan files in QGroundControl's format (default: made for the region)")  # fmt: skip
    add("--world", metavar="WORLD", help="your own world, by name or file (default: generated from the seed)")
    add("--height", type=checked(lambda text: within("height", text, *_HEIGHTS, "m")), default=12.0, metavar="M",
        help="height of the lowest vehicle; the others are staggered above it, m (default: %(default)s)")  # fmt: skip
    add("--on-find", choices=["hold", "return", "continue"], default="hold",
        help="behaviour of the other vehicles after a find (default: %(default)s)")  # fmt: skip
    add("--follow-time", type=checked(lambda text: within("follow time", text, 0.0, 3600.0, "s")), default=60.0,
        metavar="S", help="time for which a found person is followed, s (default: %(default)s)")  # fmt: skip
    add("--time-limit", type=checked(lambda text: within("time limit", text, 30.0, 7200.0, "s")), default=900.0,
        metavar="S", help="simulated time after which all vehicles return, s (default: %(default)s)")  # fmt: skip
    add("--camera-rate", type=checked(lambda text: within("camera rate", text, *_RATES, "Hz")), default=2.0,
        metavar="HZ", help="picture rate of each camera, Hz (default: %(default)s)")  # fmt: skip
    add("--speed", type=checked(options.speed), default=0.0, metavar="FACTOR",
        help="target real-time factor, or 'unlimited' (default: unlimited)")  # fmt: skip
    add("--no-film", action="store_true", help="no views.mp4")
    add("--headless", action="store_true", help="no live display: print a line of progress every few seconds")
    add("--logs", action="store_true", help="write the vehicles' flight logs (PX4's ULog)")
    add("--out", type=Path, metavar="FOLDER", help="new folder for the results (default: runs/<time>)")
    options.add_master(parser)
    options.add_instance(parser)


def whole(name: str, text: str, low: int, high: int) -> int:
    """Return an integer within limits.

    Raises:
        OptionError: the text is no such number.
    """
    try:
        value = int(text)
    except ValueError:
        value = low - 1
    if not low <= value <= high:
        raise OptionError(f"{name}: {text!r} is not allowed; a whole number from {low} to {high}")
    return value


def within(name: str, text: str, low: float, high: float, unit: str) -> float:
    """Return a number within limits.

    Raises:
        OptionError: it is not.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise OptionError(f"{name}: {text!r} is not allowed; {low:g} to {high:g} {unit}")
    return value


def settings_of(arguments: argparse.Namespace) -> SearchSettings:
    """Return the settings of the search, after all checks that need no ROS.

    Raises:
        OptionError, FleetError: a value is not allowed.
    """
    fleet = f"{arguments.type}:{arguments.n}"
    parse_fleet(fleet)
    if arguments.world and arguments.persons != 1:
        raise OptionError("persons: they are in the world's file; leave out --persons where --world is given")
    return SearchSettings(
        n=arguments.n,
        type=arguments.type,
        region=_path(arguments.region, "region"),
        plans=_path(arguments.plans, "plans"),
        world=arguments.world or "",
        persons=arguments.persons,
        walking=not arguments.standing,
        height=arguments.height,
        on_find=arguments.on_find,
        follow_time=arguments.follow_time,
        time_limit=arguments.time_limit,
        camera_rate=arguments.camera_rate,
        film=not arguments.no_film,
        seed=arguments.seed,
        speed=arguments.speed,
        out=options.results_folder(arguments.out, recorded=True),
        master_port=master_port(arguments.master_port, use_running=arguments.use_master),
        headless=arguments.headless,
        logs=arguments.logs,
        instance=options.take_instance(fleet, arguments.instance),
    )


def _path(wanted: Path | None, name: str) -> str:
    if wanted is None:
        return ""
    if not wanted.exists():
        raise OptionError(f"{name}: {str(wanted)!r} does not exist")
    return str(wanted.resolve())


def run(arguments: argparse.Namespace) -> int:
    """Search and return the exit status; see :func:`~xtdrone_interaction.search_demo.run_search`."""
    return run_reported(lambda: run_search(settings_of(arguments), PatientConsole()))
