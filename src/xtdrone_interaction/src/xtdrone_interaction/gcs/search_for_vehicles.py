"""Search for vehicles: in a simulation of this machine, at its ports, or by the heartbeats on a connection."""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import time
from collections.abc import Collection
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_control.fleet import MAX_VEHICLES
from xtdrone_control.mavlink.wire.codec import FrameError, split
from xtdrone_control.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_interaction import simulation_services

from .exchanges import exchange
from .station import TIMEOUT, GroundStation
from .udp_tcp_serial import open_connection
from .vehicle_addresses import ANY, LOOPBACK, GcsError, Peer, numbered

_LIMIT = 3.0  # s for vehicles to answer
_RUNS = (Path("runs"), simulation_services.RUNS)


def running_fleet(instance: int) -> str:
    """Return the vehicles of the simulation with this number that runs on this machine, as ``parse_fleet`` reads them.

    Empty if none is found by ROS_MASTER_URI or the flights of this workspace: an autopilot may run without ROS.
    """
    for place in (None, *simulation_services.flights(_RUNS)):
        with contextlib.suppress(
            OSError, simulation_services.SimError
        ):  # a flight that ends or starts now, another program
            fleet = _fleet(_master(place), instance)
            if fleet:
                return fleet
    return ""


def _master(file: Path | None) -> str:
    """Return the master that a flight has written to its file; that of the environment for None."""
    if file is None:
        return os.environ.get("ROS_MASTER_URI", simulation_services.DEFAULT_MASTER)
    return file.read_text(encoding="utf-8").strip()


def _fleet(master: str, instance: int) -> str:
    if simulation_services.find_service(master, "/simulator/get_status") is None:
        return ""
    if (simulation_services.parameter(master, "/xtdrone/instance") or 0) != instance:
        return ""
    return str(simulation_services.parameter(master, "/xtdrone/fleet") or "")


def find(host: str = LOOPBACK, limit: float = _LIMIT, instance: int = 0) -> list[Peer]:
    """Return the vehicles that answer at the ports of a simulation, in order, with their system ids.

    Args:
        host: machine of the simulation.
        limit: s to wait for answers; shorter where the machine reports that all other ports are closed.
        instance: number of the simulation on that machine.

    Raises:
        GcsError: unknown machine.
    """
    try:
        address = socket.gethostbyname(host)  # once, not per datagram
    except (OSError, UnicodeError) as error:
        raise GcsError(f"{host}: no such machine: {getattr(error, 'strerror', None) or error}") from error
    peers = [numbered(number, host=address, instance=instance) for number in range(MAX_VEHICLES)]
    with GroundStation(peers) as station:
        futures = {peer: station.submit(peer, exchange.await_heartbeat(), patience=limit) for peer in station.peers}
        end = time.monotonic() + limit
        while time.monotonic() < end:
            station.poll(TIMEOUT)
            if all(future.done() or station.is_unreachable(peer) for peer, future in futures.items()):
                break
        done = [peer for peer, future in futures.items() if future.done() and future.exception() is None]
        return [Peer(peer.name, futures[peer].result().system, host, peer.port) for peer in done]


def listen(address: tuple[str, str, int], limit: float = _LIMIT, wanted: Collection[int] = ()) -> list[Peer]:
    """Return the vehicles whose heartbeats arrive over a connection, by system id.

    Args:
        address: scheme, host and port.
        limit: s to wait for heartbeats.
        wanted: system ids; the search ends once all of them are found. Empty: it lasts for ``limit``.

    Raises:
        GcsError: the connection cannot be opened, or ends.
    """
    connection = open_connection(*address)
    heartbeat = MESSAGE_ID["HEARTBEAT"]
    mav = mavlink.MAVLink(None, srcSystem=exchange.SYSTEM, srcComponent=exchange.COMPONENT)
    found: set[int] = set()
    try:
        with selectors.DefaultSelector() as selector:
            selector.register(connection, selectors.EVENT_READ)
            end = time.monotonic() + limit
            while (now := time.monotonic()) < end and not (wanted and found.issuperset(wanted)):
                for message in exchange.probe():
                    connection.send(message.pack(mav), ANY)
                if not selector.select(min(TIMEOUT, end - now)):
                    continue
                for chunk in connection.receive():
                    with contextlib.suppress(FrameError):
                        for number, system, component, _ in split(chunk):
                            if (number, component) == (heartbeat, exchange.AUTOPILOT):
                                found.add(system)
    finally:
        connection.close()
    return [Peer(f"system_{system}", system, *address[1:], address[0]) for system in sorted(found)]
