"""MAVLink server of all vehicles, with three UDP ports for each, like the PX4 instances of upstream XTDrone.

One port serves MAVROS (offboard), one ground stations, and one payloads at low bandwidth; each accepts several clients.
PX4's fourth port, for gimbals, is left out: it carries only messages of PX4's gimbal manager.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from xtdrone_autopilot.commander.commander import Commander
from xtdrone_autopilot.mavlink.streams.stream_schedule import GCS_RATES, ONBOARD_RATES, PAYLOAD_RATES, Payloads
from xtdrone_autopilot.mavlink.streams.telemetry import Telemetry
from xtdrone_common.fleet import Vehicle

from .client_link import Address, Link
from .rate_limit import MAX_CREDIT, STEP_CREDIT, VEHICLE_CREDIT, Credit, DatagramQueues, cost
from .receiver import Receiver
from .udp_port_and_clients import CLIENTS, LOOPBACK, VEHICLE_CLIENTS, ClientLimit, Port

if TYPE_CHECKING:
    from xtdrone_autopilot.autopilot import Autopilot

_MAX_DATAGRAMS = 4096  # read from one socket in a round: more than its buffer holds, but bounded against a flood
_NEVER = 1 << 62  # microseconds: the fleet is empty
_FAST, _SLOW = 4_000_000, 4000  # bytes/s: nominal capacity of links in PX4's SITL
_KEEP_ALIVE_PERIOD = 0.1  # s of wall time between two checks of the heartbeats to ground stations
_STANDSTILL = 0.1  # s of wall time after which simulated time counts as standing still
_PART_PERIOD = 0.02  # s of wall time between two parts of a transfer during a standstill
_PART_CREDIT = 32.0  # credit of all clients in that period while a tick waits for a slow participant


class _Vehicle:
    """The ports of one vehicle and the receiver of their messages."""

    def __init__(
        self,
        vehicle: Vehicle,
        autopilot: Autopilot,
        commander: Commander,
        index: int,
        host: str,
        limit: ClientLimit,
        totals: dict[int, int],
    ) -> None:
        self.index = index
        self.commander = commander
        self._next_due_us: int | None = None
        telemetry = Telemetry(commander, autopilot, index)
        ends = (
            ("offboard", vehicle.offboard_local_port, vehicle.offboard_remote_port, ONBOARD_RATES, _FAST, False),
            ("ground-station", vehicle.gcs_local_port, vehicle.gcs_remote_port, GCS_RATES, _FAST, True),
            ("payload", vehicle.payload_local_port, vehicle.payload_remote_port, PAYLOAD_RATES, _SLOW, False),
        )
        common: dict[str, Any] = {"limit": limit, "totals": totals, "due_changed": self._due_changed}
        self.ports: list[Port] = []
        try:
            for kind, local, remote, rates, data_rate, by_wall in ends:
                place = vehicle, kind, local, remote
                self.ports.append(Port(*place, telemetry, rates, host, data_rate=data_rate, by_wall=by_wall, **common))
        except OSError:
            self.close()
            raise
        self.receiver = Receiver(commander, autopilot, index, self.clients, self._due_changed)

    def clients(self) -> list[Link]:
        """Return the links with active streams, in a fixed order."""
        return [link for port in self.ports for link in port.links if link.streams.active]

    @property
    def message_count(self) -> int:
        """Number of messages sent to clients so far, plus queued texts and events."""
        sent = sum(link.sent for port in self.ports for link in port.links)
        return sent + len(self.commander.texts) + len(self.commander.events)

    def _due_changed(self) -> None:
        self._next_due_us = None

    @property
    def next_due_us(self) -> int:
        """Simulated time, microseconds, at which ``send`` is due next, unless there are texts."""
        if self._next_due_us is None:
            self._next_due_us = min(self.receiver.next_due_us, *[port.next_due_us for port in self.ports])
        return self._next_due_us

    def reboot(self, autopilot: Autopilot, commander: Commander) -> None:
        self.commander = commander
        self.receiver = Receiver(commander, autopilot, self.index, self.clients, self._due_changed)
        self._due_changed()
        telemetry = Telemetry(commander, autopilot, self.index)
        for port in self.ports:
            port.reboot(telemetry, autopilot.time_us)

    def send(self, now_us: int) -> None:
        """Send the texts, the telemetry and the messages of services that are due by ``now_us``."""
        texts = self.commander.texts
        if not texts and now_us < self.next_due_us:
            return
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


_PortKey = tuple[_Vehicle, Port]


class _Socket(NamedTuple):
    """A socket with its port and vehicle."""

    served: _Vehicle
    port: Port
    socket: socket.socket


class MavlinkServer:
    """MAVLink of a fleet. All calls come from one thread; only ``receive`` with a timeout blocks.

    Attributes:
        sent: datagrams sent so far, by remote port; updated as they are sent.
    """

    def __init__(
        self, fleet: Sequence[Vehicle], autopilot: Autopilot, commanders: Sequence[Commander], host: str = LOOPBACK
    ) -> None:
        """Bind all ports.

        Args:
            fleet: the vehicles, in the order of the autopilot's records, which may be more; see ``add_vehicle``.
            autopilot: autopilot that holds the records.
            commanders: one for each record; a replaced element means that the vehicle's autopilot was rebooted.
            host: address to listen on; "0.0.0.0" for every network.

        Raises:
            LinkError: a port is in use; the message names vehicle, link and port. No port stays bound then.
        """
        self._autopilot = autopilot
        self._commanders = commanders
        self._host = host
        self._vehicles: dict[int, _Vehicle] = {}  # by index, in its order
        self.sent: dict[int, int] = {}
        self._sockets: dict[int, _Socket] = {}  # by descriptor
        self._common = select.epoll()  # sockets open to every sender
        self._reserved = select.epoll()  # sockets of single participants
        self._all = select.epoll()
        self._polls_common = True
        self._holding = False
        self._ports: list[Port] = []
        self._port_keys: dict[Port, _PortKey] = {}
        self._next_keep_alive = self._next_part = 0.0
        self._last_step = (-1, 0.0)  # simulated time at the last check, us, and wall time at which it was reached
        self._credit = Credit(STEP_CREDIT, MAX_CREDIT)
        self._queues: DatagramQueues[_PortKey] = DatagramQueues()
        self._limit = ClientLimit(CLIENTS)
        try:
            for index, vehicle in enumerate(fleet):
                self.add_vehicle(index, vehicle)
        except OSError:
            self.close()
            raise
        for poll in (self._common, self._reserved):
            self._all.register(poll.fileno(), select.EPOLLIN)

    def add_vehicle(self, index: int, vehicle: Vehicle, received: Mapping[int, int] | None = None) -> None:
        """Bind the ports of a vehicle.

        Args:
            index: of its records and its commander.
            vehicle: the vehicle.
            received: initial counts of datagrams by local port; None: 0.

        Raises:
            LinkError: a port is in use; none stays bound then.
        """
        commander = self._commanders[index]
        served = _Vehicle(vehicle, self._autopilot, commander, index, self._host, self._limit, self.sent)
        self._vehicles = dict(sorted({**self._vehicles, index: served}.items()))
        self._limit.left += VEHICLE_CLIENTS
        for port in served.ports:
            port.received = (received or {}).get(port.local_port, 0)
            self._port_keys[port] = served, port
            self._watch(self._common, _Socket(served, port, port.socket))
        self._update_ports()
        if self._holding:
            served.receiver.hold_setpoints()

    def remove_vehicle(self, index: int) -> None:
        """Close the ports of a vehicle that leaves; its clients receive nothing more."""
        served = self._vehicles.pop(index)
        for port in served.ports:
            for descriptor in [one for one, entry in self._sockets.items() if entry.port is port]:
                entry = self._sockets.pop(descriptor)
                (self._common if entry.socket is port.socket else self._reserved).unregister(descriptor)
            self._queues.drop(self._port_keys.pop(port))
        served.close()
        self._limit.left -= VEHICLE_CLIENTS
        self._update_ports()

    def _update_ports(self) -> None:
        self._ports = [port for served in self._vehicles.values() for port in served.ports]
        self._credit.set_rate(STEP_CREDIT + VEHICLE_CREDIT * len(self._vehicles))

    def fileno(self) -> int:
        """Return a descriptor that is readable when a datagram can be handled."""
        return self._all.fileno()

    @property
    def next_due_us(self) -> int:
        """Simulated time, microseconds, at which ``send_streams`` is due next."""
        return min([served.next_due_us for served in self._vehicles.values()], default=_NEVER)

    @property
    def ports(self) -> list[Port]:
        """All ports, for their counters."""
        return self._ports

    @property
    def messages(self) -> tuple[str, ...]:
        """Names of the handled messages."""
        return next(iter(self._vehicles.values())).receiver.messages

    @property
    def received(self) -> dict[int, int]:
        """Datagrams read so far, by local port."""
        return {port.local_port: port.received for port in self._ports}

    def direct(self, ports: Iterable[int], host: str, *, override: bool = False) -> None:
        """Set the host of first clients that have not sent yet.

        Args:
            ports: remote ports of the first clients.
            host: address of their machine.
            override: also replace clients that have already sent messages, because they are gone.
        """
        wanted = set(ports)
        for port in self._ports:
            if port.remote_port in wanted:
                port.direct(host, self._autopilot.time_us, override=override)

    def reserve(self, peers: Mapping[int, Collection[str]]) -> None:
        """Reserve sockets for lockstep participants, whose datagrams are handled on arrival under any load.

        Args:
            peers: remote port to the addresses of the machines from which participants send. Addresses reserved
                before and missing here become ordinary clients.
        """
        now_us = self._autopilot.time_us
        for served, port in self._port_keys.values():
            hosts = peers.get(port.remote_port, ())
            new, gone = port.reserve([(host, port.remote_port) for host in hosts], now_us)
            for one in gone:
                entry = self._sockets.pop(one.fileno())
                self._reserved.unregister(one.fileno())
                self._read(entry, now_us)
                one.close()
            for one in new:
                self._watch(self._reserved, _Socket(served, port, one))
            if new:  # earlier datagrams first
                self._read(_Socket(served, port, port.socket), now_us)

    def _watch(self, poll: select.epoll, entry: _Socket) -> None:
        self._sockets[entry.socket.fileno()] = entry
        poll.register(entry.socket.fileno(), select.EPOLLIN)

    def receive(self, timeout: float = 0.0) -> int:
        """Read all received datagrams, waiting up to ``timeout`` seconds of wall time for the first.

        Datagrams of participants are handled on arrival, the others as ``rate_limit`` allows.

        Returns:
            Number of datagrams read.
        """
        now_us = self._autopilot.time_us
        self._accrue_credit(now_us)
        if timeout > 0.0:
            self._all.poll(0.0 if self.backlog else timeout)
        count = 0
        for poll in (self._common, self._reserved) if self._polls_common else (self._reserved,):
            for descriptor, _ in poll.poll(0.0):
                count += self._read(self._sockets[descriptor], now_us)
        if self._queues:
            self._serve_queues(now_us)
        self._poll_common(not self._holding or self._credit.left > 0.0)
        return count

    @property
    def backlog(self) -> bool:
        """Return whether ``receive`` would handle a queued datagram now."""
        return len(self._queues) > 0 and (self._credit.left > 0.0 or not self._holding)

    def _accrue_credit(self, now_us: int) -> None:
        """Add credit for elapsed time; restore all of it while time stands still between ticks."""
        if not self._credit.accrue(now_us) and not self._holding:
            self._credit.fill()

    def _poll_common(self, wanted: bool) -> None:
        """Poll the common sockets too (``wanted``), or only those of participants."""
        if wanted != self._polls_common:
            self._polls_common = wanted
            self._all.modify(self._common.fileno(), select.EPOLLIN if wanted else 0)

    def _read(self, entry: _Socket, now_us: int) -> int:
        """Read a socket: handle datagrams of participants, queue the others. Return the number of datagrams."""
        served, port, source = entry
        count, more, from_participant = 0, True, False
        while more and count < _MAX_DATAGRAMS:
            arrived, more = port.read(source)
            count += len(arrived)
            for datagram, sender in arrived:
                if source is not port.socket or port.is_reserved(sender):
                    from_participant = True
                    served.receiver.handle_datagram(port, datagram, sender, now_us, participant=True)
                    port.count_bytes(sender, len(datagram))
                elif not self._queues.put((served, port), sender, datagram, known=port.find_link(sender) is not None):
                    port.drop(sender, now_us)
        if from_participant:
            port.flush(now_us)
        return count

    @staticmethod
    def _handle(served: _Vehicle, port: Port, datagram: bytes, sender: Address, now_us: int) -> int:
        """Handle a datagram; return its cost."""
        link, total = port.find_link(sender), served.message_count
        before = 0 if link is None else link.sent
        served.receiver.handle_datagram(port, datagram, sender, now_us)
        port.count_bytes(sender, len(datagram))
        total = served.message_count - total
        link = port.find_link(sender)
        replies = 0 if link is None else link.sent - before
        return cost(len(datagram), replies, max(total - replies, 0))

    def _serve_queues(self, now_us: int) -> None:
        """Handle queued datagrams, one of each sender in turn, until the credit is used up."""
        answered: dict[Port, None] = {}
        waiting = self._queues.waiting()
        while waiting:
            served = []
            for port_key, sender in waiting:
                credit = self._credit_for(port_key[1], sender, now_us)
                if credit is None:  # the sender waits for the next call
                    continue
                datagram = self._queues.pop(port_key, sender)
                credit.left -= self._handle(*port_key, datagram, sender, now_us)
                answered[port_key[1]] = None
                served.append((port_key, sender))
            waiting = [key for key in served if self._queues.is_waiting(*key)]
        for port in answered:
            port.flush(now_us)

    def _credit_for(self, port: Port, sender: Address, now_us: int) -> Credit | None:
        """Return the credit that pays for the next datagram of ``sender``, None when none is left."""
        if self._credit.left > 0.0:
            return self._credit
        link = port.find_link(sender)
        if link is None:
            return None
        link.credit.accrue(now_us)
        return link.credit if link.credit.left > 0.0 else None

    def send_streams(self, now_us: int) -> None:
        """Send queued texts, and the telemetry and the messages of services that are due by ``now_us``."""
        self.follow_reboots()
        for served in self._vehicles.values():
            served.send(now_us)

    def follow_reboots(self) -> None:
        """Serve the new commander of every vehicle whose autopilot was rebooted."""
        for index, served in self._vehicles.items():
            commander = self._commanders[index]
            if served.commander is not commander:
                served.reboot(self._autopilot, commander)

    def keep_alive(self, counted_ports: Callable[[], Collection[int]] = tuple) -> None:
        """Serve clients that run on wall time while simulated time is slow or stands still; call it periodically.

        Ground stations get a heartbeat each wall second, so that they do not report a lost link. During a standstill,
        transfers paced by simulated time (parameter lists, logs, files) continue, so that a ground station can connect
        to a paused simulation. None of this affects the flight.

        Args:
            counted_ports: returns the remote ports at which lockstep participants count received datagrams; messages to
                these must not depend on wall time.
        """
        wall = time.monotonic()
        self._continue_transfers(wall, counted_ports)
        if wall < self._next_keep_alive:
            return
        self._next_keep_alive = wall + _KEEP_ALIVE_PERIOD
        counted = counted_ports()
        for port in self._ports:
            if port.by_wall:
                port.keep_alive(self._autopilot.time_us, counted)

    @property
    def keep_alive_delay(self) -> float:
        """Wall time, s, after which ``keep_alive`` must be called again during a standstill."""
        if self.backlog:
            return 0.0
        transfers = any(served.receiver.has_transfers for served in self._vehicles.values())
        busy = self._queues or not self._polls_common or transfers
        return _PART_PERIOD if busy else _KEEP_ALIVE_PERIOD

    def _continue_transfers(self, wall: float, counted_ports: Callable[[], Collection[int]]) -> None:
        """Send the next parts of transfers if simulated time stands still."""
        now_us = self._autopilot.time_us
        if now_us != self._last_step[0]:
            self._last_step = (now_us, wall)
        if wall - self._last_step[1] < _STANDSTILL or wall < self._next_part:
            return
        self._next_part = wall + _PART_PERIOD
        self._credit.left = max(self._credit.left, _PART_CREDIT)
        self._poll_common(True)
        waiting = [served for served in self._vehicles.values() if served.receiver.has_transfers]
        if not waiting:
            return
        counted = counted_ports()
        for served in waiting:
            served.receiver.send_parts(now_us, counted)
            for port in served.ports:
                port.flush_others(now_us, counted)

    def reboot(self, autopilot: Autopilot, commanders: Sequence[Commander]) -> None:
        """Switch to rebooted autopilots and restart the streams; sockets, peers and counters are kept.

        Args:
            autopilot: autopilot that holds the new records; its time may be earlier than the old one's.
            commanders: the new commanders, one for each record.
        """
        self._autopilot = autopilot
        self._commanders = commanders
        for index, served in self._vehicles.items():
            served.reboot(autopilot, commanders[index])

    def hold_setpoints(self) -> None:
        """Begin a tick: queue setpoints of participants until ``release_setpoints``; see :class:`Receiver`."""
        self._holding = True
        for served in self._vehicles.values():
            served.receiver.hold_setpoints()

    def release_setpoints(self) -> None:
        """Apply the queued setpoints."""
        self._holding = False
        self._poll_common(True)
        for served in self._vehicles.values():
            served.receiver.release_setpoints()

    def close(self) -> None:
        """Close all sockets."""
        for poll in (self._all, self._common, self._reserved):
            poll.close()
        for served in self._vehicles.values():
            served.close()
