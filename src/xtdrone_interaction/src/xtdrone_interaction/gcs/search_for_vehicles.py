"""Search for vehicles: at the ports of a simulation, or by the heartbeats on a connection."""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from collections.abc import Collection

from pymavlink.dialects.v20 import common as mavlink

from xtdrone_autopilot.mavlink.wire.codec import FrameError, split
from xtdrone_autopilot.mavlink.wire.dialect import MESSAGE_ID
from xtdrone_common.fleet import MAX_VEHICLES

from .exchanges import exchange
from .station import TIMEOUT, GroundStation
from .udp_tcp_serial import open_connection
from .vehicle_addresses import ANY, LOOPBACK, GcsError, Peer, numbered

_LIMIT = 3.0  # s for vehicles to answer


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
