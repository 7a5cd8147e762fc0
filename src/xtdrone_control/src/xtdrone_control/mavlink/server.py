"""The MAVLink door of all vehicles: three UDP ports each, as upstream XTDrone's PX4 instances have them.

One for MAVROS (offboard), one for ground stations, and one of low bandwidth for payloads; several clients may speak on
each. PX4's further port for gimbals is not there: its only messages are those of PX4's gimbal manager.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

from xtdrone_control.autopilot.commander.commander import Commander
from xtdrone_control.fleet import Vehicle
from xtdrone_control.mavlink.streams.rare_telemetry import Reports
from xtdrone_control.mavlink.streams.streams import GCS_RATES, ONBOARD_RATES, PAYLOAD_RATES, Payloads

from .link import Address, Link
from .port import CLIENTS, LOOPBACK, VEHICLE_CLIENTS, Port, Room
from .receiver import Receiver
from .turns import SAVINGS, STEP_EARNINGS, VEHICLE_EARNINGS, Purse, Turns, cost

if TYPE_CHECKING:
    from xtdrone_control.autopilot.autopilot import Autopilot

_MAX_DATAGRAMS = 4096  # read from one socket in a round: more than its buffer holds, and a flood must not hold us
_NEVER = 1 << 62  # microseconds: no vehicle is served here
_LOOK_PERIOD = 0.1  # s of wall time between two looks at whether ground stations hear enough
_STANDSTILL = 0.1  # s of wall time from which simulated time counts as standing
_PART_PERIOD = 0.02  # s of wall time between two parts of a transfer while it stands
_PART_CREDIT = 32.0  # what clients may ask for in that time while a tick is held up: some participant's turn lasts


class _Vehicle:
    """One vehicle's ports, and what serves them."""

    def __init__(
        self, vehicle: Vehicle, autopilot: Autopilot, commander: Commander, index: int, host: str, room: Room
    ) -> None:
        self.index = index
        self.commander = commander
        telemetry = Reports(commander, autopilot, index)
        ends = (
            ("offboard", vehicle.offboard_local_port, vehicle.offboard_remote_port, ONBOARD_RATES, False),
            ("ground-station", vehicle.gcs_local_port, vehicle.gcs_remote_port, GCS_RATES, True),
            ("payload", vehicle.payload_local_port, vehicle.payload_remote_port, PAYLOAD_RATES, False),
        )
        self.ports: list[Port] = []
        try:
            for kind, local, remote, rates, by_wall in ends:
                self.ports.append(
                    Port(vehicle, kind, local, remote, telemetry, rates, host, by_wall=by_wall, room=room)
                )
        except OSError:
            self.close()
            raise
        self.receiver = Receiver(commander, autopilot, index, self.clients)

    def clients(self) -> list[Link]:
        """Return the links to everybody who listens, in a fixed order."""
        return [link for port in self.ports for link in port.links if link.streams.active]

    @property
    def told(self) -> int:
        """How many messages have been sent to clients, and texts and events wait to be."""
        sent = sum(link.sent for port in self.ports for link in port.links)
        return sent + len(self.commander.texts) + len(self.commander.events)

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


_Place = tuple[_Vehicle, Port]


class _End(NamedTuple):
    """A socket that is read, and what it belongs to."""

    served: _Vehicle
    port: Port
    socket: socket.socket


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
        self._ends: dict[int, _End] = {}  # by descriptor
        self._common = select.epoll()  # what anybody may send to
        self._reserved = select.epoll()  # those of single participants
        self._all = select.epoll()
        self._hears_all = True
        self._held = False
        room = Room(CLIENTS + VEHICLE_CLIENTS * len(fleet))
        try:
            for index, (vehicle, commander) in enumerate(zip(fleet, commanders, strict=True)):
                self._vehicles.append(_Vehicle(vehicle, autopilot, commander, index, host, room))
        except OSError:
            self.close()
            raise
        self._ports = [port for served in self._vehicles for port in served.ports]
        self._next_look = self._next_part = 0.0
        self._stood = (-1, 0.0)  # simulated time at the last look, us, and wall time since which it has been that
        self._purse = Purse(STEP_EARNINGS + VEHICLE_EARNINGS * len(self._vehicles), SAVINGS)
        self._turns: Turns[_Place] = Turns()
        self._places = {port: (served, port) for served in self._vehicles for port in served.ports}
        for served, port in self._places.values():
            self._watch(self._common, _End(served, port, port.socket))
        for poll in (self._common, self._reserved):
            self._all.register(poll.fileno(), select.EPOLLIN)

    def fileno(self) -> int:
        """Return a descriptor that is readable when a datagram has come that can be acted on."""
        return self._all.fileno()

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
            override: also where the client has spoken already: it is gone.
        """
        wanted = set(ports)
        for port in self._ports:
            if port.remote_port in wanted:
                port.direct(host, self._autopilot.time_us, override=override)

    def reserve(self, peers: Mapping[int, Collection[str]]) -> None:
        """Have sockets of their own for those whose datagrams must be acted on at once, however much others send.

        Args:
            peers: the remote ports of links to the addresses from which their clients send. Who was named before and
                is not any more is a client as others are.
        """
        now_us = self._autopilot.time_us
        for served, port in self._places.values():
            hosts = peers.get(port.remote_port, ())
            new, gone = port.reserve([(host, port.remote_port) for host in hosts], now_us)
            for one in gone:
                end = self._ends.pop(one.fileno())
                self._reserved.unregister(one.fileno())
                self._read(end, now_us)
                one.close()
            for one in new:
                self._watch(self._reserved, _End(served, port, one))
            if new:  # what came before comes first
                self._read(_End(served, port, port.socket), now_us)

    def _watch(self, poll: select.epoll, end: _End) -> None:
        self._ends[end.socket.fileno()] = end
        poll.register(end.socket.fileno(), select.EPOLLIN)

    def receive(self, timeout: float = 0.0) -> int:
        """Read all datagrams that have come, waiting up to ``timeout`` seconds of wall time for the first.

        Those of participants are acted on at once; the others take turns, see ``turns``.

        Returns:
            How many there were.
        """
        now_us = self._autopilot.time_us
        self._earn(now_us)
        if timeout > 0.0:
            self._all.poll(0.0 if self.backlog else timeout)
        count = 0
        for poll in (self._common, self._reserved) if self._hears_all else (self._reserved,):
            for descriptor, _ in poll.poll(0.0):
                count += self._read(self._ends[descriptor], now_us)
        if self._turns:
            self._take_turns(now_us)
        self._hear_all(not self._held or self._purse.left > 0.0)
        return count

    @property
    def backlog(self) -> bool:
        """Whether something waits that ``receive`` would act on now."""
        return len(self._turns) > 0 and (self._purse.left > 0.0 or not self._held)

    def _earn(self, now_us: int) -> None:
        """Give clients credit for the time that has passed, or for time that stands while no tick is held up."""
        if not self._purse.earn(now_us) and not self._held:
            self._purse.fill()

    def _hear_all(self, wanted: bool) -> None:
        """Be woken by everybody's datagrams, or only by those of participants."""
        if wanted != self._hears_all:
            self._hears_all = wanted
            self._all.modify(self._common.fileno(), select.EPOLLIN if wanted else 0)

    def _read(self, end: _End, now_us: int) -> int:
        """Read what is in a socket; act on what is a participant's, and queue the rest. Return how many there were."""
        served, port, source = end
        count, exact = 0, False
        while count < _MAX_DATAGRAMS:
            arrived = port.read(source)
            if arrived is None:
                break
            count += 1
            datagram, sender = arrived
            if source is not port.socket or port.is_reserved(sender):
                exact = True
                served.receiver.take(port, datagram, sender, now_us, participant=True)
                port.count_bytes(sender, len(datagram))
            elif not self._turns.put((served, port), sender, datagram, known=port.known(sender) is not None):
                port.drop(sender, now_us)
        if exact:
            port.flush(now_us)
        return count

    @staticmethod
    def _take(served: _Vehicle, port: Port, datagram: bytes, sender: Address, now_us: int) -> int:
        """Act on a datagram; return what it cost."""
        link, told = port.known(sender), served.told
        before = 0 if link is None else link.sent
        served.receiver.take(port, datagram, sender, now_us)
        port.count_bytes(sender, len(datagram))
        told = served.told - told
        link = port.known(sender)
        answers = 0 if link is None else link.sent - before
        return cost(len(datagram), answers, max(told - answers, 0))

    def _take_turns(self, now_us: int) -> None:
        """Act on what waits as long as there is credit for it."""
        answered: dict[Port, None] = {}
        waiting = self._turns.waiting()
        while waiting:
            served = []
            for place, sender in waiting:
                purse = self._purse_for(place[1], sender, now_us)
                if purse is None:  # nor will there be one in this round
                    continue
                datagram = self._turns.take(place, sender)
                purse.left -= self._take(*place, datagram, sender, now_us)
                answered[place[1]] = None
                served.append((place, sender))
            waiting = [key for key in served if self._turns.waits(*key)]
        for port in answered:
            port.flush(now_us)

    def _purse_for(self, port: Port, sender: Address, now_us: int) -> Purse | None:
        """Return what pays for the next datagram of ``sender``, None when it has to wait."""
        if self._purse.left > 0.0:
            return self._purse
        link = port.known(sender)
        if link is None:
            return None
        link.purse.earn(now_us)
        return link.purse if link.purse.left > 0.0 else None

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
        if self.backlog:
            return 0.0
        awaited = self._turns or not self._hears_all or any(served.receiver.waits for served in self._vehicles)
        return _PART_PERIOD if awaited else _LOOK_PERIOD

    def _go_on(self, wall: float, counted_ports: Callable[[], Collection[int]]) -> None:
        """Send the next parts of transfers if simulated time stands still."""
        now_us = self._autopilot.time_us
        if now_us != self._stood[0]:
            self._stood = (now_us, wall)
        if wall - self._stood[1] < _STANDSTILL or wall < self._next_part:
            return
        self._next_part = wall + _PART_PERIOD
        self._purse.left = max(self._purse.left, _PART_CREDIT)
        self._hear_all(True)
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
        """Begin a tick: queue what participants send until ``release_setpoints``; see :class:`Receiver`."""
        self._held = True
        for served in self._vehicles:
            served.receiver.hold()

    def release_setpoints(self) -> None:
        """Act on what was queued."""
        self._held = False
        self._hear_all(True)
        for served in self._vehicles:
            served.receiver.release()

    def close(self) -> None:
        """Close all sockets."""
        for poll in (self._all, self._common, self._reserved):
            poll.close()
        for served in self._vehicles:
            served.close()
