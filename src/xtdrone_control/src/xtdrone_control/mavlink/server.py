"""The MAVLink door of all vehicles: three UDP ports each, as upstream XTDrone's PX4 instances have them.

One for MAVROS (offboard), one for ground stations, and one of low bandwidth for payloads; several clients may speak on
each. PX4's further port for gimbals is not there: its only messages are those of PX4's gimbal manager.
"""

from __future__ import annotations

import selectors
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import chain
from typing import TYPE_CHECKING

from xtdrone_control.autopilot.commander import Commander
from xtdrone_control.fleet import GCS_REMOTE_PORT, Vehicle

from .link import Link
from .port import LOOPBACK, Port
from .receiver import Receiver
from .reports import Reports
from .streams import GCS_RATES, ONBOARD_RATES, PAYLOAD_RATES, Payloads

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

_MAX_DATAGRAMS = 4096  # read from one port in a round: more than a socket's buffer holds, and a flood must not hold us
_NEVER = 1 << 62  # microseconds: no vehicle is served here
_LOOK_PERIOD = 0.1  # s of wall time between two looks at whether ground stations hear enough
_STANDSTILL = 0.1  # s of wall time from which simulated time counts as standing
_PART_PERIOD = 0.02  # s of wall time between two parts of a transfer while it stands


class _Vehicle:
    """One vehicle's ports, and what serves them."""

    def __init__(self, vehicle: Vehicle, autopilot: Autopilot, commander: Commander, index: int, host: str) -> None:
        self.index = index
        self.commander = commander
        telemetry = Reports(commander, autopilot, index)
        ends = (
            ("offboard", vehicle.offboard_local_port, vehicle.offboard_remote_port, ONBOARD_RATES, False),
            ("ground-station", vehicle.gcs_local_port, GCS_REMOTE_PORT, GCS_RATES, True),
            ("payload", vehicle.payload_local_port, vehicle.payload_remote_port, PAYLOAD_RATES, False),
        )
        self.ports: list[Port] = []
        try:
            for kind, local, remote, rates, by_wall in ends:
                self.ports.append(Port(vehicle, kind, local, remote, telemetry, rates, host, by_wall=by_wall))
        except OSError:
            self.close()
            raise
        self.receiver = Receiver(commander, autopilot, index, self.clients)

    def clients(self) -> list[Link]:
        """Return the links to everybody who listens, in a fixed order."""
        return [link for port in self.ports for link in port.links if link.streams.active]

    def reboot(self, autopilot: Autopilot, commander: Commander) -> None:
        self.commander = commander
        self.receiver = Receiver(commander, autopilot, self.index, self.clients)
        telemetry = Reports(commander, autopilot, self.index)
        for port in self.ports:
            port.reboot(telemetry, autopilot.time_us)

    def send(self, now_us: int) -> None:
        """Send texts, telemetry, and what services have to say by ``now_us``."""
        texts = self.commander.texts
        wanted = bool(texts)
        if self.receiver.next_due_us <= now_us:
            self.receiver.update(now_us)
            wanted = True
        while texts:
            text = texts.popleft()
            for link in self.clients():
                link.send_text(*text)
        shared: Payloads = {}
        for port in self.ports:
            if wanted or port.next_due_us <= now_us:
                port.send_due(now_us, shared)

    def close(self) -> None:
        for port in self.ports:
            port.close()


def _receive(receiver: Receiver, port: Port, now_us: int) -> int:
    """Act on what has come to ``port``; return how many datagrams there were."""
    port.begin_round()
    count = 0
    while count < _MAX_DATAGRAMS:
        arrived = port.read()
        if arrived is None:
            break
        count += 1
        datagram, sender = arrived
        if port.admit(sender, now_us):
            receiver.take(port, datagram, sender, now_us)
            port.charge(sender, len(datagram))
    port.flush(now_us)
    return count


class MavlinkServer:
    """MAVLink of a fleet. One thread calls everything; nothing here blocks but ``receive`` with a timeout."""

    def __init__(
        self, fleet: Sequence[Vehicle], autopilot: Autopilot, commanders: Sequence[Commander], host: str = LOOPBACK
    ) -> None:
        """Bind all ports.

        Args:
            fleet: the vehicles, in the order of the autopilot's records.
            autopilot: holder of the records.
            commanders: one a vehicle; when another one takes a place in it, that vehicle's autopilot was rebooted.
            host: address to listen on; "0.0.0.0" for every network.

        Raises:
            LinkError: a port is taken; the message names vehicle, link and port. No port stays bound then.
        """
        self._autopilot = autopilot
        self._commanders = commanders
        self._vehicles: list[_Vehicle] = []
        self._selector = selectors.EpollSelector()
        try:
            for index, (vehicle, commander) in enumerate(zip(fleet, commanders, strict=True)):
                self._vehicles.append(_Vehicle(vehicle, autopilot, commander, index, host))
        except OSError:
            self.close()
            raise
        self._ports = [port for served in self._vehicles for port in served.ports]
        self._next_look = self._next_part = 0.0
        self._stood = (-1, 0.0)  # simulated time at the last look, us, and wall time since which it has been that
        for served in self._vehicles:
            for port in served.ports:
                self._selector.register(port.socket, selectors.EVENT_READ, (served, port))

    def fileno(self) -> int:
        """Return a descriptor that is readable when a datagram has come."""
        return self._selector.fileno()

    @property
    def next_due_us(self) -> int:
        """Simulated time, microseconds, at which ``send_streams`` has something to do next."""
        streams = (port.next_due_us for port in self._ports)
        services = (served.receiver.next_due_us for served in self._vehicles)
        return min(chain(streams, services), default=_NEVER)

    @property
    def ports(self) -> list[Port]:
        """All ports, for their counters."""
        return self._ports

    @property
    def messages(self) -> tuple[str, ...]:
        """Names of the messages that are acted on."""
        return self._vehicles[0].receiver.messages

    @property
    def sent(self) -> dict[int, int]:
        """Datagrams sent so far, by remote port."""
        totals: dict[int, int] = {}
        for port in self._ports:
            for remote, count in port.sent.items():
                totals[remote] = totals.get(remote, 0) + count
        return totals

    @property
    def received(self) -> dict[int, int]:
        """Datagrams read so far, by local port."""
        return {port.local_port: port.received for port in self._ports}

    def direct(self, ports: Iterable[int], host: str, *, override: bool = False) -> None:
        """Let what goes to one of ``ports`` from the start go to ``host``, until the client there has spoken.

        Args:
            ports: ports of first clients.
            host: address of the machine to send to.
            override: also where the client has spoken already: he is gone.
        """
        wanted = set(ports)
        for port in self._ports:
            if port.remote_port in wanted:
                port.direct(host, override=override)

    def receive(self, timeout: float = 0.0) -> int:
        """Act on all datagrams that have come, waiting up to ``timeout`` seconds of wall time for the first.

        Returns:
            How many there were; what floods is read, but only in part acted on (see ``port``).
        """
        now_us = self._autopilot.time_us
        return sum(
            _receive(served.receiver, port, now_us)
            for served, port in [key.data for key, _ in self._selector.select(timeout)]
        )

    def send_streams(self, now_us: int) -> None:
        """Send the texts that wait, the telemetry that is due by ``now_us``, and what services have to say by then."""
        for served, commander in zip(self._vehicles, self._commanders, strict=True):
            if served.commander is not commander:
                served.reboot(self._autopilot, commander)
            served.send(now_us)

    def keep_alive(self, counted_ports: Callable[[], Collection[int]] = tuple) -> None:
        """Keep clients that live by wall time going while simulated time is slow or stands still; call it now and then.

        Ground stations hear a heartbeat each second, so that they do not take the link for lost. When time stands,
        transfers that it paces (parameter lists, logs, files) go on, so that somebody can come to a paused simulation,
        look around and tell it something. Nothing of it has a part in the flight.

        Args:
            counted_ports: returns the remote ports on which lockstep participants count what comes; what goes there
                must not depend on wall time either.
        """
        wall = time.monotonic()
        self._go_on(wall, counted_ports)
        if wall < self._next_look:
            return
        self._next_look = wall + _LOOK_PERIOD
        counted = counted_ports()
        for port in self._ports:
            if port.by_wall:
                port.keep_alive(self._autopilot.time_us, counted)

    @property
    def patience(self) -> float:
        """Wall time, s, after which ``keep_alive`` is wanted again while simulated time stands."""
        return _PART_PERIOD if any(served.receiver.waits for served in self._vehicles) else _LOOK_PERIOD

    def _go_on(self, wall: float, counted_ports: Callable[[], Collection[int]]) -> None:
        """Send the next parts of transfers if simulated time stands still."""
        now_us = self._autopilot.time_us
        if now_us != self._stood[0]:
            self._stood = (now_us, wall)
        if wall - self._stood[1] < _STANDSTILL or wall < self._next_part:
            return
        self._next_part = wall + _PART_PERIOD
        waiting = [served for served in self._vehicles if served.receiver.waits]
        if not waiting:
            return
        counted = counted_ports()
        for served in waiting:
            served.receiver.send_parts(now_us, counted)
            for port in served.ports:
                port.flush_others(now_us, counted)

    def reboot(self, autopilot: Autopilot, commanders: Sequence[Commander]) -> None:
        """Go on with autopilots that have been rebooted: streams start anew; sockets, peers and counters stay.

        Args:
            autopilot: holder of the new records; its time may be before the old one's.
            commanders: the new ones, one a vehicle.
        """
        self._autopilot = autopilot
        self._commanders = commanders
        for served, commander in zip(self._vehicles, commanders, strict=True):
            served.reboot(autopilot, commander)

    def hold_setpoints(self) -> None:
        """Keep what comes from topics until ``release_setpoints``; see :class:`Receiver`."""
        for served in self._vehicles:
            served.receiver.hold()

    def release_setpoints(self) -> None:
        """Act on what was kept."""
        for served in self._vehicles:
            served.receiver.release()

    def close(self) -> None:
        """Close all sockets."""
        self._selector.close()
        for served in self._vehicles:
            served.close()
