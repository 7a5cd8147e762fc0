"""What all commands of ``xtdrone gcs`` share: the selection of vehicles, and exchanges with them, shown."""

from __future__ import annotations

import argparse
from argparse import _ArgumentGroup
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from xtdrone_common.fleet import MAX_INSTANCE, FleetError, parse_fleet
from xtdrone_common.settings import Settings, setting
from xtdrone_interaction.gcs import search_for_vehicles, station
from xtdrone_interaction.gcs.exchange_queue import AbortMessages, Job
from xtdrone_interaction.gcs.exchanges.exchange import Exchange, Heartbeat, Progress
from xtdrone_interaction.gcs.station import no_abort_messages
from xtdrone_interaction.gcs.vehicle_addresses import (
    LOOPBACK,
    GcsError,
    Peer,
    choose_systems,
    numbered,
    numbers_of,
    parse_address,
)
from xtdrone_interaction.simulation_services import running_fleet

from .terminal_output import Display

T = TypeVar("T")
Runner = Callable[[argparse.Namespace], int]


@dataclass(frozen=True)
class ConnectionSettings(Settings):
    """Settings of the connection to the vehicles."""

    instance: int = setting(
        0, low=0, high=MAX_INSTANCE, metavar="N", text="number of the simulation there, which moves its ports"
    )
    patience: float = setting(
        station.PATIENCE, low=0.1, high=3600.0, unit="s", metavar="S", text="silence after which a vehicle is given up"
    )


class UsageError(ValueError):
    """The command line has an invalid argument."""


class Commands:
    """Sub-commands of a parser."""

    def __init__(self, parser: argparse.ArgumentParser, vehicles: argparse.ArgumentParser) -> None:
        """Add them to ``parser``; ``vehicles``: parent parser with the options that select vehicles."""
        self._commands = parser.add_subparsers(required=True, metavar="COMMAND")
        self._vehicles = vehicles

    def add(self, name: str, run: Runner, text: str, for_vehicles: bool = True) -> argparse.ArgumentParser:
        """Add a command and return its parser; ``for_vehicles``: with the options that select vehicles."""
        parents = [self._vehicles] if for_vehicles else []
        command = self._commands.add_parser(name, parents=parents, help=text, description=text)
        command.set_defaults(run=run)
        return command

    def add_group(self, name: str, text: str) -> Commands:
        """Add a group of commands and return it."""
        return Commands(self._commands.add_parser(name, help=text, description=text), self._vehicles)


def add_settings(parser: _ArgumentGroup | argparse.ArgumentParser, settings: type[Settings], *names: str) -> None:
    """Add options of declared settings; without an option, the namespace has the default."""
    defaults = settings()
    for name, action in settings.add_arguments(parser, names).items():
        action.default = getattr(defaults, name)


def make_vehicle_options() -> argparse.ArgumentParser:
    """Return a parser with the options that select vehicles."""
    parser = argparse.ArgumentParser(add_help=False)
    group = parser.add_argument_group("vehicles")
    group.add_argument("--vehicle", nargs="+", default=[], metavar="V",
                       help="names (iris_0), numbers (0 2 or 0-5), or all for every vehicle that answers")  # fmt: skip
    group.add_argument("--fleet", default="", metavar="TYPE:COUNT,...",
                       help="the simulated fleet, from which ports and system ids follow (default: that of the running "
                       "simulation on this machine)")  # fmt: skip
    group.add_argument("--host", default=LOOPBACK, help="machine of the autopilots (default: %(default)s)")
    add_settings(group, ConnectionSettings, "instance")
    group.add_argument("--connect", metavar="ADDRESS",
                       help="any autopilot: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD; "
                       "numbers of vehicles are then MAVLink system ids")  # fmt: skip
    add_settings(group, ConnectionSettings, "patience")
    return parser


def select_named(names: Iterable[str], arguments: argparse.Namespace) -> list[Peer]:
    """Return the vehicles with these names.

    Raises:
        UsageError: unknown name.
    """
    try:
        return station.peers_of(names, arguments.fleet, arguments.host, arguments.instance)
    except (GcsError, FleetError) as error:
        raise UsageError(str(error)) from error


def select_vehicles(arguments: argparse.Namespace, *, or_all: bool = False) -> list[Peer]:
    """Return the vehicles of --vehicle, or all of --fleet or --connect.

    Args:
        arguments: of the command line.
        or_all: select all vehicles that answer if none of these options is given.

    Raises:
        UsageError: no selection, or an invalid one.
        GcsError: no vehicle answers.
    """
    words = [word for text in arguments.vehicle for word in text.split(",") if word]
    if not words and not (arguments.fleet or arguments.connect or or_all):
        raise UsageError("which vehicles? --vehicle NAME ..., --vehicle all or --fleet TYPE:COUNT")
    if arguments.connect:
        return _connected(words or ["all"], arguments)
    if not arguments.fleet and arguments.host == LOOPBACK:
        arguments.fleet = running_fleet(arguments.instance)
    found: dict[tuple[str, str, int], Peer] = {}
    try:
        for word in words or ["all"]:
            found.update({peer.address: peer for peer in _of_word(word, words, arguments)})
    except FleetError as error:
        raise UsageError(str(error)) from error
    return list(found.values())


def _of_word(word: str, words: list[str], arguments: argparse.Namespace) -> list[Peer]:
    """Return the vehicles that one word of --vehicle selects.

    Raises:
        UsageError, FleetError: invalid word.
        GcsError: no vehicle answers.
    """
    fleet, host, instance = arguments.fleet, arguments.host, arguments.instance
    if word == "all":
        return (
            select_named([vehicle.name for vehicle in parse_fleet(fleet, instance)], arguments)
            if fleet
            else _all(host, instance)
        )
    try:
        numbers = numbers_of(word)
        if numbers is not None:
            return [numbered(number, fleet, host, instance) for number in numbers]
    except GcsError as error:
        raise UsageError(str(error)) from error
    # all names together, because without a fleet they have to be of one type
    return select_named([other for other in words if other != "all" and numbers_of(other) is None], arguments)


def _all(host: str, instance: int) -> list[Peer]:
    peers = search_for_vehicles.find(host, instance=instance)
    if not peers:
        first = numbered(0, instance=instance).port
        raise GcsError(
            f"no vehicle answers at {host}, UDP ports {first} and above; is the simulation running? "
            "Other autopilots: --connect ADDRESS"
        )
    return peers


def _connected(words: list[str], arguments: argparse.Namespace) -> list[Peer]:
    try:
        address = parse_address(arguments.connect)
        numbers = [numbers_of(word) for word in words]
    except GcsError as error:
        raise UsageError(str(error)) from error
    named_all = None not in numbers
    wanted = {system for part in numbers if part is not None for system in part} if named_all else ()
    found = search_for_vehicles.listen(address, wanted=wanted)
    if not found:
        raise GcsError(f"{arguments.connect}: no heartbeat of an autopilot has been received")
    try:
        return choose_systems(words, found)
    except GcsError as error:
        raise UsageError(str(error)) from error


def run(
    jobs: Mapping[Peer, Job[T]], arguments: argparse.Namespace, on_abort: AbortMessages = no_abort_messages
) -> dict[str, T | GcsError]:
    """Run exchanges with the patience of the command line; see ``station.run``."""
    return station.run(jobs, patience=arguments.patience, on_abort=on_abort)


def run_shown(
    arguments: argparse.Namespace,
    peers: Sequence[Peer],
    exchange: Callable[[Peer, Progress, Heartbeat], Exchange[Any]],
    finish: Callable[[str, Any], str],
    on_abort: AbortMessages = no_abort_messages,
) -> tuple[int, dict[str, Any]]:
    """Run an exchange with each vehicle at once, show the progress and print the results.

    Args:
        arguments: Arguments of the command line.
        peers: Vehicles.
        exchange: Returns the exchange with a vehicle.
        finish: Returns the line of a vehicle from its name and its result, which it may store; raises GcsError.
        on_abort: Returns the messages that end an aborted exchange.

    Returns:
        Exit status, and result or error by name of the vehicle.
    """
    display = Display([peer.name for peer in peers])
    jobs = {peer: partial(exchange, peer, partial(display.watch, peer.name)) for peer in peers}
    results: dict[str, Any] = run(jobs, arguments, on_abort)
    return display.results(peers, results, finish), results
