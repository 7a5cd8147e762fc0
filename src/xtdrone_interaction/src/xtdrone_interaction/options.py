"""What a user may ask for, and the messages where it is not possible. No ROS here."""

from __future__ import annotations

import argparse
import errno
import math
import shutil
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.fleet import (
    INSTANCE_STEP,
    MAX_INSTANCE,
    MAX_VEHICLES,
    FleetError,
    Vehicle,
    check_instance,
    parse_fleet,
)
from xtdrone_control.speed import LEAST_SPEED
from xtdrone_coordination.patterns import Patterns, absolute_name
from xtdrone_interaction.geometry import ORIGIN

DEFAULT_FOLLOWER = "follower_consensus.py"
MAX_SWARM = 10_000  # vehicles in one process; the topology is a matrix of N x N
_LONGEST_NAME = 90  # bytes of an abstract socket's name, with room for what comes before
_BAG_ROOM = 1 << 30  # bytes; rosbag record stops where less is free


class OptionError(ValueError):
    """A value that is not allowed; the message names the thing, the value and what is allowed."""


def repository() -> Path:
    """Return the workspace's root, which holds launch/ and src/."""
    return Path(__file__).resolve().parents[4]


def vehicle_count(text: str) -> int:
    """Return the number of vehicles of a formation.

    Raises:
        OptionError: it is no whole number from 2 to MAX_VEHICLES.
    """
    try:
        count = int(text)
    except ValueError:
        count = 0
    if not 2 <= count <= MAX_VEHICLES:
        raise OptionError(f"number of vehicles: {text!r} is not allowed; 2 to {MAX_VEHICLES} make a formation")
    return count


def swarm_count(text: str) -> int:
    """Return the number of vehicles of a swarm without ROS, which MAVLink's ids do not bound.

    Raises:
        OptionError: it is no whole number of at least 2.
    """
    try:
        count = int(text)
    except ValueError:
        count = 0
    if not 2 <= count <= MAX_SWARM:
        raise OptionError(f"number of vehicles: {text!r} is not allowed; 2 to {MAX_SWARM} make a swarm")
    return count


def speed(text: str) -> float:
    """Return the target real-time factor, 0 for ``unlimited``.

    Raises:
        OptionError: it is neither ``unlimited`` nor a finite number of at least LEAST_SPEED.
    """
    if text == "unlimited":
        return 0.0
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= LEAST_SPEED):
        raise OptionError(
            f"speed: {text!r} is not allowed; a real-time factor of at least {LEAST_SPEED}, or 'unlimited'"
        )
    return value


def positive(name: str, text: str) -> float:
    """Return a finite number above 0.

    Raises:
        OptionError: it is not.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise OptionError(f"{name}: {text!r} is not allowed; a number above 0")
    return value


def seed(text: str) -> int:
    """Return a seed.

    Raises:
        OptionError: it is no whole number from 0 to 2^31 - 1, the range of a ROS parameter.
    """
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value < 2**31:
        raise OptionError(f"seed: {text!r} is not allowed; a whole number from 0 to {2**31 - 1}")
    return value


def port(text: str) -> int:
    """Return a TCP port.

    Raises:
        OptionError: it is no whole number from 1024 to 65535.
    """
    try:
        value = int(text)
    except ValueError:
        value = 0
    if not 1024 <= value <= 65535:
        raise OptionError(f"port: {text!r} is not allowed; 1024 to 65535")
    return value


def instance(text: str) -> int:
    """Return the number of a simulation on this machine.

    Raises:
        OptionError: there is no such instance.
    """
    try:
        return check_instance(text)
    except FleetError as error:
        raise OptionError(str(error)) from error


def split_patterns(text: str) -> list[str]:
    """Return the names in a comma-separated list, files in them (clouds, fonts) with their whole paths.

    Raises:
        OptionError: there is none, or an empty one.
    """
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise OptionError(f"patterns: {text!r} is not allowed; names with commas between, as cube,sphere,text:XTD")
    return [absolute_name(name) for name in names]


PATTERNS_HELP = (
    "patterns to fly, with commas between: those of XTDrone for this number, and for every number origin, cube, "
    "pyramid, triangle, grid, circle, sphere, text:WORDS[:font=FILE] (letters, to be read from the south), cloud:FILE "
    "(points of a .ply, .npy, .xyz or .csv); each may end in :spacing=METRES, the least distance of two vehicles "
    "(default: cube,pyramid,triangle)"
)


def swarm_patterns(count: int, names: list[str], file: str | None = None) -> dict[str, NDArray[np.float64]]:
    """Return the slots of ``names`` and of origin for ``count`` vehicles, shape (count - 1, 3), m from the leader.

    Raises:
        PatternError: an unknown name, a pattern of the wrong size, or an unreadable file.
    """
    patterns = Patterns(count, file)
    return {name: patterns.offsets(name) for name in dict.fromkeys([ORIGIN, *names])}


def one_of_files(thing: str, name: str, folder: Path) -> str:
    """Return ``name`` when ``folder`` has a YAML file of that name.

    Raises:
        OptionError: it has not.
    """
    known = sorted(path.stem for path in folder.glob("*.yaml"))
    if name not in known:
        raise OptionError(f"{thing}: {name!r} is unknown; there are: {', '.join(known) or 'none'}")
    return name


def new_folder(wanted: Path) -> Path:
    """Return an absolute folder for results: it is not there, or empty.

    Raises:
        OptionError: it is there with something in it, or roslaunch cannot pass its name on.
    """
    folder = wanted.resolve()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OptionError(f"out: {str(wanted)!r} is there and not an empty folder")
    if any(c.isspace() for c in str(folder)):
        raise OptionError(f"out: {str(folder)!r} has a space in it, which roslaunch cannot pass on; choose --out")
    return folder


def results_folder(wanted: Path | None, *, recorded: bool = False) -> Path:
    """Return the results' folder, absolute: ``wanted``, or ``runs/<time>``; it is not there, or empty.

    Args:
        wanted: None for the default.
        recorded: whether ``rosbag record`` is to write into it, which records nothing on a disk that is nearly full.

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
            f"out: {str(folder)!r} is on a disk with {free >> 20} MB left; rosbag records with at least "
            f"{_BAG_ROOM >> 20} MB; choose --out"
        )


def checked(check: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return ``check`` with its message as argparse wants it."""

    def convert(text: str) -> Any:
        try:
            return check(text)
        except OptionError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return convert


def add_master(parser: argparse.ArgumentParser) -> None:
    """Add the options that say which ROS master is used."""
    master = parser.add_mutually_exclusive_group()
    master.add_argument("--master-port", type=checked(port), metavar="PORT",
                        help="TCP port of the flight's own ROS master (default: a free one)")  # fmt: skip
    master.add_argument("--use-master", action="store_true", help="use the running master of ROS_MASTER_URI")


def add_instance(parser: argparse.ArgumentParser) -> None:
    """Add the option that says which of the simulations on this machine it is."""
    parser.add_argument("--instance", type=checked(instance), metavar="N",
                        help="of the simulations on this machine, which moves the UDP ports by N x "
                        f"{INSTANCE_STEP} (default: the first whose ports are free)")  # fmt: skip


def follower_program(text: str) -> tuple[str, str]:
    """Return (program, class): a program of xtdrone_coordination by its name, or a file with the user's own class.

    Raises:
        OptionError: it is neither.
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
    """Return the file with the user's own leader class, absolute, and the class's name if there is one; "" for None.

    Raises:
        OptionError: there is no such file.
    """
    if text is None:
        return ""
    found = _class_file(text)
    if found is None:
        raise OptionError(f"leader: {text!r} is no FILE.py[:CLASS]")
    return found


def _class_file(text: str) -> str | None:
    """Return ``file.py[:Class]`` with the file's absolute path; None where there is no such file."""
    file, _, name = text.partition(":")
    path = Path(file).resolve()
    if not (path.suffix == ".py" and path.is_file()):
        return None
    return f"{path}:{name}" if name else str(path)


def free_port() -> int:
    """Return a TCP port of this machine that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def check_master_port(number: int) -> int:
    """Return ``number`` when a ROS master can listen there.

    Raises:
        OptionError: somebody else does.
    """
    if _taken(number, socket.SOCK_STREAM):
        raise OptionError(f"port: {number} is taken by another program (a roscore?); leave it out to get a free one")
    return number


def check_vehicle_ports(fleet: tuple[Vehicle, ...]) -> None:
    """Check that the MAVLink ports of all vehicles are free.

    Raises:
        OptionError: one is taken; the message names it and the vehicle.
    """
    for vehicle in fleet:
        for number in _udp_ports(vehicle):
            if _taken(number, socket.SOCK_DGRAM):
                raise OptionError(
                    f"port: UDP {number} of {vehicle.name} is taken by another program; a simulation beside another "
                    f"one is an instance of its own: --instance N, up to {MAX_INSTANCE}"
                )


def _udp_ports(vehicle: Vehicle) -> tuple[int, ...]:
    local = vehicle.offboard_local_port, vehicle.gcs_local_port, vehicle.payload_local_port
    return (*local, vehicle.offboard_remote_port)


def take_instance(fleet: str, wanted: int | None) -> int:
    """Return the number of an instance whose ports are free, and keep other commands from taking it.

    Args:
        fleet: which vehicles it has, as ``iris:9``.
        wanted: its number; None for the first that is free.

    Raises:
        OptionError: it is not free, or none is.
        FleetError: the fleet is none.
    """
    if wanted is not None:
        if not _take(f"instance-{wanted}"):
            raise OptionError(f"instance: {wanted} flies already; another one of 0 to {MAX_INSTANCE} may be free")
        check_vehicle_ports(parse_fleet(fleet, wanted))
        return wanted
    for instance in range(MAX_INSTANCE + 1):
        free = not any(_taken(port, socket.SOCK_DGRAM) for v in parse_fleet(fleet, instance) for port in _udp_ports(v))
        if free and _take(f"instance-{instance}"):
            return instance
    raise OptionError(f"port: the UDP ports of each instance from 0 to {MAX_INSTANCE} are taken by other programs")


_kept: dict[str, socket.socket] = {}


def _take(name: str) -> bool:
    """Keep a name for this process until it ends; return whether no other process has it.

    The kernel knows the name, in the namespace in which ports are known, and forgets it with the process.
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
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the master does: TIME_WAIT is no obstacle
        try:
            probe.bind(("0.0.0.0", number))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return True
            raise
    return False
