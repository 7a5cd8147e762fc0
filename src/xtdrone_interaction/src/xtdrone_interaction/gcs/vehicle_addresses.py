"""Addresses of vehicles, from their names, numbers and system ids."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from xtdrone_common.fleet import MAX_VEHICLES, Vehicle, parse_fleet

LOOPBACK = "127.0.0.1"
SCHEMES = ("udpout", "udpin", "tcp", "serial")
ANY = 0
"""System id of a vehicle whose system id is not known yet."""

_NAME = re.compile(r"([a-z][a-z0-9_]*)_(\d+)")
_NUMBERS = re.compile(r"(\d+)(?:-(\d+))?")
_UNNAMED = "vehicle"  # type of a vehicle known by number only
_LAST_PORT = 65535
_FASTEST = 10_000_000  # baud
_LAST_SYSTEM = 255


class GcsError(Exception):
    """An operation has failed; the message names the vehicle and the reason."""


@dataclass(frozen=True)
class Peer:
    """A vehicle and its address.

    Attributes:
        name: such as ``typhoon_h480_0``.
        system: MAVLink system id; ``ANY`` for whichever autopilot answers.
        host, port: of its ground-station link; the local end for ``udpin``; device and baud rate for ``serial``.
        scheme: one of ``SCHEMES``: send to a UDP port, bind a UDP port, connect over TCP, open a serial device.
    """

    name: str
    system: int
    host: str
    port: int
    scheme: str = "udpout"

    @staticmethod
    def of(vehicle: Vehicle, host: str = LOOPBACK) -> Peer:
        """Return the address of ``vehicle`` in a simulation on the machine ``host``."""
        return Peer(vehicle.name, vehicle.system_id, host, vehicle.gcs_local_port)

    @property
    def address(self) -> tuple[str, str, int]:
        """Scheme, host and port; vehicles with the same address share a connection."""
        return self.scheme, self.host, self.port


def peers_of(names: Iterable[str], fleet: str = "", host: str = LOOPBACK, instance: int = 0) -> list[Peer]:
    """Return the addresses of vehicles in a simulation.

    Args:
        names: of the vehicles.
        fleet: such as ``iris:3,typhoon_h480:2``; empty for a fleet of one type.
        host: machine of the simulation.
        instance: number of the simulation on that machine.

    Raises:
        GcsError: an invalid name, a name outside of the fleet, or names of several types without a fleet.
        FleetError: invalid fleet.
    """
    names = list(names)
    known = parse_fleet(fleet, instance) if fleet else ()
    by_name = {vehicle.name: vehicle for vehicle in known}
    parts = [_NAME.fullmatch(name) for name in names]
    types = {part[1] for part in parts if part}
    found = []
    for name, part in zip(names, parts, strict=True):
        if part is None:
            raise GcsError(f"vehicle: {name!r} is not allowed, a type and a number, as typhoon_h480_0")
        if not known and len(types) > 1:
            raise GcsError(f"vehicles of several types ({', '.join(sorted(types))}): specify the fleet, as "
                           f"--fleet {','.join(f'{kind}:1' for kind in sorted(types))}")  # fmt: skip
        if known and name not in by_name:
            raise GcsError(f"vehicle: {name!r} is not allowed, one of the fleet {fleet}")
        number = int(part[2])
        vehicle = by_name.get(name) or parse_fleet(f"{part[1]}:{number + 1}", instance)[number]
        found.append(Peer.of(vehicle, host))
    return found


def numbers_of(word: str) -> range | None:
    """Parse a number or range such as ``3`` or ``0-5``; None for other words.

    Raises:
        GcsError: the last number is less than the first.
    """
    match = _NUMBERS.fullmatch(word)
    if match is None:
        return None
    first, last = int(match[1]), int(match[2] or match[1])
    if last < first:
        raise GcsError(f"vehicle: {word!r} is not allowed, the lower number first")
    return range(first, last + 1)


def numbered(number: int, fleet: str = "", host: str = LOOPBACK, instance: int = 0) -> Peer:
    """Return the address of a vehicle by its number in the fleet; without a fleet, its name and system id are unknown.

    Raises:
        GcsError: the number is out of range.
        FleetError: invalid fleet.
    """
    vehicles = parse_fleet(fleet, instance) if fleet else ()
    count = len(vehicles) or MAX_VEHICLES
    if number >= count:
        raise GcsError(f"vehicle: {number} is not allowed, 0 to {count - 1}")
    if vehicles:
        return Peer.of(vehicles[number], host)
    return Peer(f"{_UNNAMED}_{number}", ANY, host, Vehicle(_UNNAMED, number, number, instance).gcs_local_port)


def parse_address(text: str) -> tuple[str, str, int]:
    """Parse an address such as ``udpin:0.0.0.0:14550`` or ``serial:/dev/ttyACM0:57600``.

    Returns:
        Scheme, host and port.

    Raises:
        GcsError: invalid address.
    """
    scheme, _, rest = text.partition(":")
    host, _, port = rest.rpartition(":")
    number = int(port) if port.isascii() and port.isdecimal() else 0
    if scheme not in SCHEMES or not host or not 1 <= number <= (_FASTEST if scheme == "serial" else _LAST_PORT):
        raise GcsError(f"connect: {text!r} is not allowed, udpout, udpin or tcp with host and port, as "
                       "udpin:127.0.0.1:14550, or serial:DEVICE:BAUD")  # fmt: skip
    return scheme, host, number


def choose_systems(words: Sequence[str], found: Sequence[Peer]) -> list[Peer]:
    """Select vehicles on a connection by ``all``, names, or system ids such as ``1`` and ``2-4``.

    Raises:
        GcsError: a word that selects none of them.
    """
    chosen: dict[Peer, None] = {}
    by_system = {peer.system: peer for peer in found}
    by_name = {peer.name: peer for peer in found}
    there = ", ".join(str(system) for system in by_system)
    for word in words:
        if word == "all":
            chosen |= dict.fromkeys(found)
            continue
        numbers = numbers_of(word)
        if numbers is not None and numbers[-1] > _LAST_SYSTEM:
            raise GcsError(f"vehicle: {word!r} is not allowed, system ids are 1 to {_LAST_SYSTEM}")
        wanted = [by_name.get(word)] if numbers is None else [by_system.get(number) for number in numbers]
        if None in wanted:
            raise GcsError(f"vehicle: {word!r} is not allowed, of the systems on this connection: {there}")
        chosen |= dict.fromkeys(peer for peer in wanted if peer is not None)
    return list(chosen)
