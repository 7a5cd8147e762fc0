"""Options that several commands share, and checks of files, folders and ports. This module does not import ROS."""

from __future__ import annotations

import argparse
import errno
import shutil
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.fleet import (
    INSTANCE_STEP,
    MAX_INSTANCE,
    MAX_VEHICLES,
    XTDRONE,
    FleetError,
    Vehicle,
    check_instance,
    parse_fleet,
)
from xtdrone_common.programs.node_command_line import ArgumentError
from xtdrone_common.programs.user_classes import load_class
from xtdrone_common.settings import Settings, setting
from xtdrone_coordination.patterns import Patterns, absolute_name
from xtdrone_interaction.recording.topics import ORIGIN

_Base = TypeVar("_Base")

DEFAULT_FOLLOWER = "follower_consensus.py"
MAX_SWARM = 10_000  # vehicles in one process; the topology is a matrix of N x N
_LONGEST_NAME = 90  # bytes of an abstract socket's name, with room for the prefix
_BAG_ROOM = 1 << 30  # bytes; the recorder stops if less is free


PATTERNS_HELP = (
    "patterns to fly, with commas between: those of XTDrone for this number, and for every number origin, cube, "
    "pyramid, triangle, grid, circle, sphere, text:WORDS[:font=FILE] (letters, to be read from the south), cloud:FILE "
    "(points of a .ply, .npy, .xyz or .csv); each may end in :spacing=METRES, the minimum distance of two vehicles "
    "(default: cube,pyramid,triangle)"
)


class OptionError(ValueError):
    """A value that is not allowed; the message names the thing, the value and what is allowed."""


def repository() -> Path:
    """Return the workspace's root, which holds launch/ and src/."""
    return Path(__file__).resolve().parents[4]


def _parse_patterns(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise ValueError("comma-separated names, as cube,sphere,text:XTD")
    return [absolute_name(name) for name in names]


def parse_instance(text: object) -> int:
    """Parse the number of a simulation on this machine.

    Raises:
        ValueError: not allowed; the text states what is.
    """
    try:
        return check_instance(text)
    except FleetError as error:
        raise ValueError(f"a whole number from 0 to {MAX_INSTANCE}") from error


def seed_setting(text: str = "seed of all noise") -> Any:
    """Declare a seed, within the range of a ROS parameter."""
    return setting(0, low=0, high=2**31 - 1, metavar="SEED", text=text)


def patterns_setting() -> Any:
    """Declare the patterns to fly; files in their names are absolute."""
    default = ("cube", "pyramid", "triangle")
    return setting(default, parse=_parse_patterns, metavar="NAMES", text=PATTERNS_HELP)


def clearance_setting() -> Any:
    """Declare the minimum height of the slots."""
    return setting(3.0, above=0.0, unit="m", metavar="M", text="minimum height of any slot above the ground")


def vehicles_setting(default: int = 9, low: int = 2, high: int = MAX_VEHICLES, text: str = "number of vehicles") -> Any:
    """Declare a number of vehicles."""
    return setting(default, low=low, high=high, metavar="N", text=text)


@dataclass(frozen=True)
class MachineSettings(Settings):
    """Ports of a flight on this machine."""

    master_port: int | None = setting(
        None,
        low=1024,
        high=65535,
        metavar="PORT",
        text="TCP port of the flight's own ROS master (default: a free one)",
    )
    instance: int | None = setting(
        None,
        parse=parse_instance,
        metavar="N",
        text=f"number of this simulation on this machine, which moves the UDP ports by N x {INSTANCE_STEP} (default: "
        "the first one with free ports)",
    )


def split_patterns(text: str) -> list[str]:
    """Return the names in a comma-separated list, files in them (clouds, fonts) with their absolute paths.

    Raises:
        OptionError: the list or a name is empty.
    """
    try:
        return _parse_patterns(text)
    except ValueError as error:
        raise OptionError(f"patterns: {text!r} is not allowed, {error}") from error


def swarm_patterns(count: int, names: Sequence[str], file: str | None = None) -> dict[str, NDArray[np.float64]]:
    """Return the slots of ``names`` and of origin for ``count`` vehicles, shape (count - 1, 3), m from the leader.

    Raises:
        PatternError: an unknown name, a pattern of the wrong size, or an unreadable file.
    """
    patterns = Patterns(count, file)
    return {name: patterns.offsets(name) for name in dict.fromkeys([ORIGIN, *names])}


def one_of_files(thing: str, name: str, folder: Path) -> str:
    """Return ``name`` if ``folder`` has a YAML file of that name.

    Raises:
        OptionError: there is no such file.
    """
    known = sorted(path.stem for path in folder.glob("*.yaml"))
    if name not in known:
        raise OptionError(f"{thing}: {name!r} is unknown; there are: {', '.join(known) or 'none'}")
    return name


def new_folder(wanted: Path) -> Path:
    """Return the absolute path of a folder for results that does not exist or is empty.

    Raises:
        OptionError: the path exists and is not an empty folder, or has a space, which roslaunch cannot handle.
    """
    folder = wanted.resolve()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OptionError(f"out: {str(wanted)!r} already exists and is not an empty folder")
    if any(c.isspace() for c in str(folder)):
        raise OptionError(f"out: {str(folder)!r} has a space in it, which roslaunch cannot pass on; choose --out")
    return folder


def results_folder(wanted: Path | None, *, recorded: bool = False) -> Path:
    """Return the absolute results folder: ``wanted``, or ``runs/<time>``; it does not exist or is empty.

    Args:
        wanted: None for the default.
        recorded: whether a bag will be written into it, which needs free disk space.

    Raises:
        OptionError: see :func:`new_folder`; or the disk is too full.
    """
    if wanted is None:
        base = Path("runs") / time.strftime("%Y%m%d-%H%M%S")
        wanted, number = base, 1
        while wanted.exists() or not _take(f"out-{wanted.resolve()}"[-_LONGEST_NAME:]):
            number += 1
            wanted = base.with_name(f"{base.name}-{number}")
    folder = new_folder(wanted)
    if recorded:
        _check_room(folder)
    return folder


def _check_room(folder: Path) -> None:
    there = next(place for place in (folder, *folder.parents) if place.exists())
    free = shutil.disk_usage(there).free
    if free < _BAG_ROOM:
        raise OptionError(
            f"out: {str(folder)!r} is on a disk with {free >> 20} MB left; a flight is recorded with at least "
            f"{_BAG_ROOM >> 20} MB; choose --out"
        )


def output_folder(wanted: Path | None, usual: Path) -> Path:
    """Return the folder of results, created if necessary: ``wanted``, else ``usual``.

    Raises:
        OptionError: it cannot be created or written to.
    """
    folder = wanted or usual
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OptionError(f"out: {str(folder)!r} cannot be written to: {error.strerror}") from error
    return folder


def checked(check: Callable[[str], Any]) -> Callable[[str], Any]:
    """Wrap ``check`` so that its errors are those argparse expects."""

    def convert(text: str) -> Any:
        try:
            return check(text)
        except OptionError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return convert


def add_master(parser: argparse.ArgumentParser) -> None:
    """Add the options that select the ROS master."""
    master = parser.add_mutually_exclusive_group()
    MachineSettings.add_arguments(master, ("master_port",))
    master.add_argument("--use-master", action="store_true", help="use the running master of ROS_MASTER_URI")


def add_instance(parser: argparse.ArgumentParser) -> None:
    """Add the option that selects the instance of the simulation on this machine."""
    MachineSettings.add_arguments(parser, ("instance",))


def web_setting() -> Any:
    """Declare whether a flight has a page for browsers; an argument of its launch file."""
    return setting(False, text="serve the page of the flight to a browser, see docs/web.md; prints its URL")


def add_world(parser: argparse.ArgumentParser) -> None:
    """Add the option that selects the world."""
    parser.add_argument(
        "--world",
        default="empty",
        metavar="WORLD",
        help="world by name (empty, outdoor, ...), or an SDF or YAML file (default: %(default)s)",
    )


def world(text: str) -> str:
    """Return a world as the launch files take it: a name, or the absolute path of a file.

    Raises:
        OptionError: there is no such world, or its file is invalid.
    """
    from xtdrone_worlds.descriptions import ModelError
    from xtdrone_worlds.worlds.catalogue import is_known, known_names, load_world

    name = text if is_known(text) else str(Path(text).expanduser().absolute())
    if any(c.isspace() for c in name):
        raise OptionError(f"world: {name!r} has a space in it, which roslaunch cannot pass on")
    if name != text and not name.endswith((".world", ".sdf", ".yaml", ".yml")):
        raise OptionError(
            f"world: {text!r} is unknown; there are {', '.join(known_names())}, or a file: .world, .sdf, .yaml"
        )
    try:
        load_world(name)
    except ModelError as error:
        raise OptionError(f"world: {error}") from error
    return name


def follower_program(text: str) -> tuple[str, str]:
    """Return (program, class): a program of xtdrone_coordination by its name, or a file with the user's class.

    Raises:
        OptionError: ``text`` is neither.
    """
    shipped = repository() / "src" / "xtdrone_coordination" / "nodes"
    if "/" not in text and (shipped / text).is_file():
        return text, ""
    found = _class_file(text)
    if found is None:
        file = text.partition(":")[0]
        if file.endswith(".py") and not Path(file).is_file():
            raise OptionError(f"follower: {file} does not exist")
        known = ", ".join(sorted(p.name for p in shipped.glob("follower*.py")))
        raise OptionError(f"follower: {text!r} is neither FILE.py[:CLASS] nor one of the programs {known}")
    return DEFAULT_FOLLOWER, found


def leader_class(text: str | None) -> str:
    """Return the absolute file of the user's leader class, with ``:Class`` if given; "" for None.

    Raises:
        OptionError: the file does not exist.
    """
    return _class_option("leader", text)


def follower_class(text: str | None) -> str:
    """Return the absolute file of the user's follower class, with ``:Class`` if given; "" for None.

    Raises:
        OptionError: the file does not exist.
    """
    return _class_option("follower", text)


def _class_option(name: str, text: str | None) -> str:
    if text is None:
        return ""
    found = _class_file(text)
    if found is None:
        raise OptionError(f"{name}: {text!r} is no FILE.py[:CLASS]")
    return found


def checked_class(text: str, base: type[_Base], what: str) -> type[_Base]:
    """Return the user's class, imported before the start so that an error in it is reported here, or ``base``."""
    if not text:
        return base
    try:
        return load_class(text, base, what)
    except ArgumentError as error:
        raise OptionError(str(error)) from error


def _class_file(text: str) -> str | None:
    """Return ``file.py[:Class]`` with the file's absolute path; None if the file does not exist."""
    file, _, name = text.partition(":")
    path = Path(file).resolve()
    if not (path.suffix == ".py" and path.is_file()):
        return None
    return f"{path}:{name}" if name else str(path)


def free_port() -> int:
    """Return a free TCP port of this machine, which no other command of this project takes meanwhile."""
    while True:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            number = int(probe.getsockname()[1])
        if f"port-{number}" not in _kept and _take(f"port-{number}"):
            return number


def check_master_port(number: int) -> int:
    """Return ``number`` if a ROS master can listen on that TCP port.

    Raises:
        OptionError: the port is taken.
    """
    if _taken(number, socket.SOCK_STREAM):
        raise OptionError(f"port: {number} is taken by another program (a roscore?); leave it out to get a free one")
    return number


def check_vehicle_ports(fleet: tuple[Vehicle, ...], *, with_mavros: bool = True) -> None:
    """Check that the MAVLink ports which a simulation of the vehicles binds are free.

    Args:
        fleet: the vehicles.
        with_mavros: whether our MAVROS layer binds its end, too; real MAVROS may already listen there otherwise.

    Raises:
        OptionError: a port is taken; the message names the port and the vehicle.
    """
    for vehicle in fleet:
        for number in _udp_ports(vehicle, with_mavros):
            if _taken(number, socket.SOCK_DGRAM):
                real = " (beside real MAVROS: mavros:=false)" if number == vehicle.offboard_remote_port else ""
                raise OptionError(
                    f"port: UDP {number} of {vehicle.name} is taken by another program{real}; a simulation beside "
                    f"another one is an instance of its own: --instance N, up to {MAX_INSTANCE}"
                )


def _udp_ports(vehicle: Vehicle, with_mavros: bool) -> tuple[int, ...]:
    local = vehicle.offboard_local_port, vehicle.gcs_local_port, vehicle.payload_local_port
    return (*local, vehicle.offboard_remote_port) if with_mavros else local


def take_instance(fleet: str, wanted: int | None, *, with_mavros: bool = True, ports: str = XTDRONE) -> int:
    """Reserve an instance whose ports are free, and return its number.

    Args:
        fleet: vehicles of the instance, as ``iris:9``.
        wanted: number; None for the first free one.
        with_mavros: see ``check_vehicle_ports``.
        ports: of the offboard links, see ``parse_fleet``.

    Raises:
        OptionError: the instance is not free, or none is.
        FleetError: the fleet is invalid.
    """
    if wanted is not None:
        if not _take(f"instance-{wanted}"):
            raise OptionError(f"instance: {wanted} flies already; another one of 0 to {MAX_INSTANCE} may be free")
        check_vehicle_ports(parse_fleet(fleet, wanted, ports), with_mavros=with_mavros)
        return wanted
    for instance in range(MAX_INSTANCE + 1):
        vehicles = parse_fleet(fleet, instance, ports)
        needed = [number for vehicle in vehicles for number in _udp_ports(vehicle, with_mavros)]
        if not any(_taken(number, socket.SOCK_DGRAM) for number in needed) and _take(f"instance-{instance}"):
            return instance
    raise OptionError(f"port: the UDP ports of each instance from 0 to {MAX_INSTANCE} are taken by other programs")


_kept: dict[str, socket.socket] = {}


def _take(name: str) -> bool:
    """Reserve a name for this process until it ends; return whether no other process holds it.

    The name is that of an abstract socket: the kernel keeps it per network namespace and frees it with the process.
    """
    if name in _kept:
        return True
    keeper = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        keeper.bind(f"\0xtdrone-{name}")
    except OSError:
        keeper.close()
        return False
    _kept[name] = keeper
    return True


def _taken(number: int, kind: int) -> bool:
    with socket.socket(socket.AF_INET, kind) as probe:
        if kind == socket.SOCK_STREAM:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # like the master, which ignores TIME_WAIT
        try:
            probe.bind(("0.0.0.0", number))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return True
            raise
    return False
