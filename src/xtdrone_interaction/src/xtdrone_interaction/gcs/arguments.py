"""What the commands of ``xtdrone gcs`` share: which vehicles they are for, and how they are reached."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Protocol, TypeVar

from xtdrone_control.fleet import FleetError, check_instance, parse_fleet

from . import station
from .peers import LOOPBACK, GcsError, Peer, choose_systems, numbered, numbers_of, parse_address
from .station import Job

T = TypeVar("T")
Runner = Callable[[argparse.Namespace], int]


class UsageError(ValueError):
    """What was asked for is not allowed."""


class Adder(Protocol):
    """What adds a command; ``for_vehicles``: it is for vehicles, and has the options that say for which."""

    def __call__(self, name: str, run: Runner, text: str, for_vehicles: bool = True) -> argparse.ArgumentParser:
        """Return the command's parser."""

    def group(self, name: str, text: str) -> Adder:
        """Return what adds commands below one."""


def seconds(text: str) -> float:
    """Return a number of seconds that an option gives.

    Raises:
        ArgumentTypeError: it is none, or not of 0.1 to 3600.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.1 <= value <= 3600.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not allowed; a number of seconds from 0.1 to 3600")
    return value


def instance(text: str) -> int:
    """Return the number of a simulation on a machine.

    Raises:
        ArgumentTypeError: there is no such instance.
    """
    try:
        return check_instance(text)
    except FleetError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def common() -> argparse.ArgumentParser:
    """Return the options that say which vehicles are meant."""
    parser = argparse.ArgumentParser(add_help=False)
    group = parser.add_argument_group("vehicles")
    group.add_argument("--vehicle", nargs="+", default=[], metavar="V",
                       help="only these: names as iris_0, numbers as 0 2 or 0-5, or all that are there")  # fmt: skip
    group.add_argument("--fleet", default="", metavar="TYPE:COUNT,...",
                       help="the fleet that flies, needed for names where it has several types, since ports and "
                       "system ids follow from it")  # fmt: skip
    group.add_argument("--host", default=LOOPBACK, help="machine of the autopilots (default: %(default)s)")
    group.add_argument("--instance", type=instance, default=0, metavar="N",
                       help="of that machine's simulations, which moves the ports (default: %(default)s)")  # fmt: skip
    group.add_argument("--connect", metavar="ADDRESS",
                       help="any autopilot: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD; "
                       "numbers of vehicles are MAVLink system ids then")  # fmt: skip
    group.add_argument("--patience", type=seconds, default=station.PATIENCE, metavar="S",
                       help="give a vehicle up that is silent for so long (default: %(default)g s)")  # fmt: skip
    return parser


def named(names: Iterable[str], arguments: argparse.Namespace) -> list[Peer]:
    """Return where the vehicles of these names are met.

    Raises:
        UsageError: a name that leads nowhere.
    """
    try:
        return station.peers_of(names, arguments.fleet, arguments.host, arguments.instance)
    except (GcsError, FleetError) as error:
        raise UsageError(str(error)) from error


def chosen(arguments: argparse.Namespace, *, or_all: bool = False) -> list[Peer]:
    """Return the vehicles of --vehicle, else all of --fleet or --connect.

    Args:
        arguments: of the command line.
        or_all: without any of these all that are there are meant.

    Raises:
        UsageError: it is not said which, or what is said leads nowhere.
        GcsError: no vehicle is there.
    """
    words = [word for text in arguments.vehicle for word in text.split(",") if word]
    if not words and not (arguments.fleet or arguments.connect or or_all):
        raise UsageError("which vehicles? --vehicle NAME ..., --vehicle all or --fleet TYPE:COUNT")
    if arguments.connect:
        return _connected(words or ["all"], arguments)
    found: dict[tuple[str, str, int], Peer] = {}
    try:
        for word in words or ["all"]:
            found.update({peer.line: peer for peer in _of_word(word, words, arguments)})
    except FleetError as error:
        raise UsageError(str(error)) from error
    return list(found.values())


def _of_word(word: str, words: list[str], arguments: argparse.Namespace) -> list[Peer]:
    """Return the vehicles that a word means.

    Raises:
        UsageError, FleetError: it leads nowhere.
        GcsError: no vehicle is there.
    """
    fleet, host, instance = arguments.fleet, arguments.host, arguments.instance
    if word == "all":
        return named([vehicle.name for vehicle in parse_fleet(fleet)], arguments) if fleet else _all(host, instance)
    try:
        numbers = numbers_of(word)
        if numbers is not None:
            return [numbered(number, fleet, host, instance) for number in numbers]
    except GcsError as error:
        raise UsageError(str(error)) from error
    # together, since they have to be of one type where no fleet is given
    return named([other for other in words if other != "all" and numbers_of(other) is None], arguments)


def _all(host: str, instance: int) -> list[Peer]:
    peers = station.find(host, instance=instance)
    if not peers:
        first = numbered(0, instance=instance).port
        raise GcsError(f"no vehicle answers at {host}, UDP ports {first} and above; does the simulation "
                       "run? Other autopilots: --connect ADDRESS")  # fmt: skip
    return peers


def _connected(words: list[str], arguments: argparse.Namespace) -> list[Peer]:
    try:
        address = parse_address(arguments.connect)
        numbers = [numbers_of(word) for word in words]
    except GcsError as error:
        raise UsageError(str(error)) from error
    named_all = None not in numbers
    wanted = {system for part in numbers if part is not None for system in part} if named_all else ()
    found = station.listen(address, wanted=wanted)
    if not found:
        raise GcsError(f"{arguments.connect}: no autopilot's heartbeat has come over it")
    try:
        return choose_systems(words, found)
    except GcsError as error:
        raise UsageError(str(error)) from error


def run(
    jobs: Mapping[Peer, Job[T]], arguments: argparse.Namespace, closing: station.Closing = station.no_closing
) -> dict[str, T | GcsError]:
    """Run exchanges with the patience that the command line says; see ``station.run``."""
    return station.run(jobs, patience=arguments.patience, closing=closing)
