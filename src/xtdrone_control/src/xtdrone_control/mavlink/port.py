"""One UDP port of one vehicle, and the clients that speak on it.

A port knows its first client before it speaks: the streams go to its address from the start and for ever, as PX4's
do; where the operating system answers that no socket is there, heartbeats alone. Every other sender becomes a further
client with a link of its own, up to ``MAX_CLIENTS`` of them, and is forgotten when it has been silent for 5 s. When
there is no room, newcomers are not answered; no client has to go for them.

A participant of the lockstep has a socket of its own here (``reserve``), connected to its address: whatever others
send, its datagrams have a buffer to themselves and are acted on at once. All others take turns, see ``turns``.
"""

from __future__ import annotations

import errno
import logging
import socket
import time
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field

from xtdrone_control.fleet import Vehicle
from xtdrone_control.mavlink.streams.streams import Payloads
from xtdrone_control.mavlink.streams.telemetry import Telemetry

from .link import Address, Link

LOOPBACK = "127.0.0.1"
MAX_CLIENTS = 16  # on one port
CLIENTS = 16  # on all ports of a server besides each port's first client,
VEHICLE_CLIENTS = 2  # and for each vehicle: what they are sent takes the simulator's time
_MAX_COUNTS = 256  # remote ports whose datagrams are counted; lockstep participants may come back to theirs
_MAX_REFUSALS = 4096  # noted at once
_LARGEST_DATAGRAM = 8192  # what is longer is cut off, as PX4 does
_RECEIVE_BUFFER = 1 << 20
_WARNING_INTERVAL_US = 1_000_000
_WARNING_INTERVAL_S = 1.0
_ROOM_INTERVAL_S = 0.1
_IP_RECVERR = 11  # Linux: keep refusals with the address that refused
_ICMP_ERRORS = (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.EPROTO)

_log = logging.getLogger("rosout.mavlink")


class LinkError(OSError):
    """A link whose port cannot be bound."""


def _share(sockets: Iterable[socket.socket], value: int) -> None:
    """Let ``sockets`` be bound to one port together, or end that; what is bound stays so."""
    for one in sockets:
        if one.fileno() != -1:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, value)


@dataclass
class Room:
    """Room for clients on several ports.

    Attributes:
        left: how many more there may be, each port's first client aside.
        ports: those that share it.
    """

    left: int
    ports: list[Port] = field(default_factory=list)
    _next_look: float = 0.0

    def make(self, now_us: int) -> None:
        """Forget silent clients of all ports, at most every 0.1 s of wall time; time may stand meanwhile."""
        wall = time.monotonic()
        if wall >= self._next_look:
            self._next_look = wall + _ROOM_INTERVAL_S
            for port in self.ports:
                port.forget_silent(now_us)
                if port.by_wall:
                    port.forget_silent(now_us, by_wall_alone=True)


class Port:
    """One end of MAVLink over UDP.

    Attributes:
        name: vehicle and kind of link, for messages.
        system_id: the vehicle's MAVLink system id.
        local_port: bound port.
        remote_port: port of the first client.
        default: the link to the first client.
        telemetry: what the vehicle tells.
        rates: default rates of the streams, message name to Hz.
        by_wall: whether clients live by wall time, as a ground station does: they are silent only if they are so by
            both clocks. Else simulated time alone counts, so that the streams are the same at any speed.
        received: datagrams read.
        sent: datagrams sent by remote port.
        lost: datagrams that the operating system did not take.
        malformed: datagrams that were not, or not wholly, MAVLink.
        foreign: messages for other systems.
        dropped: datagrams that were not looked at since there was no room left for their sender's, see ``turns``.
        refused: messages of newcomers for whom there was no room.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        kind: str,
        local_port: int,
        remote_port: int,
        telemetry: Telemetry,
        rates: Mapping[str, float],
        host: str = LOOPBACK,
        *,
        by_wall: bool = False,
        room: Room | None = None,
    ) -> None:
        """Bind the port.

        Args:
            vehicle: whose port this is.
            kind: what the link is called in messages.
            local_port: port to bind.
            remote_port: port on this machine to which frames go from the start, unless ``direct`` names another.
            telemetry: what the vehicle tells.
            rates: default rates of the streams, message name to Hz.
            host: address to bind; "0.0.0.0" for every network.
            by_wall: see above.
            room: how many more clients there may be on all ports that share it.

        Raises:
            LinkError: the port cannot be bound, or there is no such address here.
        """
        self.name = f"{vehicle.name} {kind} link"
        self.system_id = vehicle.system_id
        self.local_port = local_port
        self.remote_port = remote_port
        self.telemetry = telemetry
        self.rates = rates
        self.by_wall = by_wall
        self.received = 0
        self.sent: dict[int, int] = {}
        self.lost = 0
        self.malformed = 0
        self.foreign = 0
        self.dropped = 0
        self.refused = 0
        self._warned: dict[str, tuple[int, float]] = {}
        self._room = room or Room(MAX_CLIENTS)
        self._room.ports.append(self)
        self._next_due_us: int | None = None
        self.default = self._first_client((LOOPBACK, remote_port))
        self._links: dict[Address, Link] = {self.default.peer: self.default}
        self._reserved: dict[Address, socket.socket] = {}
        self._participants: frozenset[Address] = frozenset()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            self.socket.setsockopt(socket.IPPROTO_IP, _IP_RECVERR, 1)
            self.socket.setblocking(False)
            self.socket.bind((host, local_port))
        except OSError as error:
            self.socket.close()
            advice = "it must be an address of this machine"
            if error.errno == errno.EADDRINUSE:
                advice = "is another simulator, PX4 or ground station using it?"
            raise LinkError(
                error.errno,
                f"{self.name}: UDP port {local_port} cannot be bound on {host}: {error.strerror or error}; {advice}",
            ) from error

    def _first_client(self, peer: Address) -> Link:
        link = Link(self, peer, self.name)
        link.constant = True
        return link

    @property
    def links(self) -> list[Link]:
        """The links to all clients: the first one's, then the others' in the order of their coming."""
        return list(self._links.values())

    @property
    def first_version(self) -> int:
        """The MAVLink version in which a client is addressed that has not spoken yet (MAV_PROTO_VER)."""
        return 2 if self.telemetry.protocol == 2 else 1

    def version_for(self, spoken: int, before: int) -> int:
        """Return the MAVLink version for a client that speaks version ``spoken``.

        It is answered in MAVLink 2 once it has spoken it, else in MAVLink 1. A real PX4 sends MAVLink 2 to all clients
        unless MAV_PROTO_VER is set otherwise, which a client that knows only MAVLink 1 could not read. With 1 in that
        parameter all are answered in MAVLink 1.

        Args:
            spoken: version of the client's last frame.
            before: what was sent to it until now; 0 when this is its first frame.
        """
        if self.telemetry.protocol == 1:
            return 1
        return max(spoken, before)

    def close(self) -> None:
        """Close the sockets."""
        for reserved in self._reserved.values():
            reserved.close()
        self.socket.close()

    def reboot(self, telemetry: Telemetry, now_us: int) -> None:
        """Start anew for an autopilot that has been rebooted: streams begin again; socket, clients, counters stay.

        Args:
            telemetry: what the rebooted vehicle tells.
            now_us: simulated time, microseconds; it may have gone back.
        """
        self.telemetry = telemetry
        self._warned.clear()
        for link in self._links.values():
            link.reboot(telemetry, now_us)

    def direct(self, host: str, now_us: int, *, override: bool = False) -> None:
        """Have the first client at ``host`` unless it has spoken; with ``override`` also then, for it is gone."""
        if self.default.has_spoken and not override:
            return
        peer = (host, self.remote_port)
        if peer == self.default.peer:
            return
        others = [link for link in self._links.values() if link is not self.default]
        self.default.close()
        known = self._links.get(peer)
        if known is not None:
            self._room.left += 1
        self.default = known or self._first_client(peer)
        self.default.name, self.default.constant = self.name, True
        self._links = {peer: self.default, **{link.peer: link for link in others}}
        self._note_part(now_us)
        self._next_due_us = None

    # what comes

    def reserve(self, peers: Collection[Address], now_us: int) -> tuple[list[socket.socket], list[socket.socket]]:
        """Have a socket of its own for each of ``peers``, and for no other address.

        An address to which there is no way from here gets none; if none of ``peers`` gets one, that is warned of.

        Args:
            peers: addresses.
            now_us: simulated time, microseconds.

        Returns:
            The sockets that are new, and those that are no longer wanted, which the caller closes when it has read
            what is in them.
        """
        gone = [self._reserved.pop(peer) for peer in list(self._reserved) if peer not in peers]
        new, reason = [], ""
        for peer in peers:
            if peer in self._reserved:
                continue
            try:
                made = self._connected(peer)
            except OSError as error:
                reason = f"no socket for {peer[0]}:{peer[1]} alone: {error.strerror or error}"
                continue
            self._reserved[peer] = made
            new.append(made)
        self._participants = frozenset(peers)
        self._note_part(now_us)
        if reason and not self._reserved:
            self.warn("reserve", reason, now_us)
        return new, gone

    def _note_part(self, now_us: int) -> None:
        participates = self.default.peer in self._participants
        if participates != self.default.participant:
            self.default.take_part(participates, now_us)

    def _connected(self, peer: Address) -> socket.socket:
        """Return a socket on the same port to which the operating system gives what ``peer`` sends."""
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        sharing = [self.socket, *self._reserved.values(), made]
        try:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            made.setblocking(False)
            _share(sharing, 1)
            made.bind(self.socket.getsockname())
            made.connect(peer)
        except OSError:
            made.close()
            raise
        finally:
            _share(sharing, 0)  # other programs shall not get the port besides
        return made

    def is_reserved(self, sender: Address) -> bool:
        """Whether ``sender`` has a socket of its own."""
        return sender in self._reserved

    def read(self, source: socket.socket) -> tuple[bytes, Address] | None:
        """Return the next datagram on one of the port's sockets and its sender, None when there is none."""
        while True:
            try:
                datagram, sender = source.recvfrom(_LARGEST_DATAGRAM)
            except BlockingIOError:
                return None
            except OSError as error:
                if error.errno not in _ICMP_ERRORS:
                    raise
                self._note_refusals(source)  # of an earlier datagram
                continue
            self.received += 1
            return datagram, sender

    def known(self, sender: Address) -> Link | None:
        """Return the link to ``sender`` if it is a client."""
        return self._links.get(sender)

    def count_bytes(self, sender: Address, size: int) -> None:
        """Count a datagram of ``size`` bytes that was acted on, if its sender is a client."""
        link = self._links.get(sender)
        if link is not None:
            link.received_bytes += size

    def drop(self, sender: Address, now_us: int) -> None:
        """Note that a datagram of ``sender`` is not looked at, because too many wait already."""
        self.dropped += 1
        link = self._links.get(sender)
        if link is not None:
            link.dropped += 1
        if not self._may_warn("flood", now_us):
            return
        who = "strangers send" if link is None else f"{sender[0]}:{sender[1]} sends"
        self.warn("flood", f"{who} more than can be served; {self.dropped} datagrams were dropped so far", now_us)

    def note_malformed(self, sender: Address) -> None:
        """Count a datagram of ``sender`` that was not, or not wholly, MAVLink."""
        self.malformed += 1
        link = self._links.get(sender)
        if link is not None:
            link.malformed += 1

    def link_of(self, sender: Address, now_us: int) -> Link | None:
        """Return the link to ``sender``, which has sent a valid message; None when there is no room for it."""
        link = self._links.get(sender)
        if link is not None:
            return link
        if len(self._links) >= MAX_CLIENTS or self._room.left < 1:
            self._room.make(now_us)
        if len(self._links) >= MAX_CLIENTS or self._room.left < 1:
            self.refused += 1
            if not self._may_warn("room", now_us):
                return None
            clients = f"{MAX_CLIENTS} clients" if self._room.left > 0 else "as many clients as all ports may have"
            self.warn("room", f"{sender[0]}:{sender[1]} is not served: there are {clients} already", now_us)
            return None
        self._room.left -= 1
        link = Link(self, sender, f"{self.name} to {sender[0]}:{sender[1]}")
        self._links[sender] = link
        self._next_due_us = None
        return link

    # what goes out

    def streams_changed(self) -> None:
        """Note that some link's streams are due at other times than before."""
        self._next_due_us = None

    @property
    def next_due_us(self) -> int:
        """Simulated time, microseconds, at which ``send_due`` has something to do next."""
        if self._next_due_us is None:
            self._next_due_us = min(link.streams.next_due_us for link in self._links.values())
        return self._next_due_us

    def send_due(self, now_us: int, shared: Payloads) -> None:
        """Send the telemetry that is due, and what is queued, and forget clients that are gone.

        Args:
            now_us: simulated time, microseconds.
            shared: see ``Streams.due``.
        """
        self.forget_silent(now_us)
        for link in self._links.values():
            link.send_due(now_us, shared)
        self._next_due_us = None

    def forget_silent(self, now_us: int, *, by_wall_alone: bool = False) -> None:
        """Forget silent clients but the first one.

        Args:
            now_us: simulated time, microseconds.
            by_wall_alone: those that are silent by wall time, whatever the simulated time is.
        """
        if len(self._links) == 1:
            return
        silent = [
            link for link in self._links.values() if (link.silent_by_wall if by_wall_alone else link.silent(now_us))
        ]
        for link in silent:
            if link is self.default:
                continue
            link.close()
            del self._links[link.peer]
            self._room.left += 1
            self._next_due_us = None
            self._forget_counts()

    def _forget_counts(self) -> None:
        """Keep the table of what was sent small: of clients that are gone, the oldest counts go first."""
        living = {link.peer[1] for link in self._links.values()}
        for port in [port for port in self.sent if port not in living][: max(len(self.sent) - _MAX_COUNTS, 0)]:
            del self.sent[port]

    def keep_alive(self, now_us: int, counted: Collection[int]) -> None:
        """Send a HEARTBEAT to whom the last one was sent more than a wall second ago, save to ``counted`` ports."""
        for link in self._links.values():
            if link.peer[1] not in counted:
                link.keep_alive(now_us)

    def flush(self, now_us: int) -> None:
        """Send what is queued."""
        for link in self._links.values():
            link.flush(now_us)

    def flush_others(self, now_us: int, counted: Collection[int]) -> None:
        """Send what is queued for clients that are not at ``counted`` ports."""
        for link in self._links.values():
            if link.peer[1] not in counted:
                link.flush(now_us)

    def send(self, datagram: bytes, peer: Address, now_us: int) -> bool:
        """Send a datagram; say whether the operating system took it, and count it."""
        try:
            try:
                self.socket.sendto(datagram, peer)
            except OSError as error:
                if error.errno not in _ICMP_ERRORS:
                    raise
                self._note_refusals(self.socket)  # of an earlier datagram, to this or another client
                self.socket.sendto(datagram, peer)
        except OSError as error:
            self.lost += 1
            self.warn("send", f"cannot send to {peer[0]}:{peer[1]}: {error.strerror}", now_us)
            return False
        self.sent[peer[1]] = self.sent.get(peer[1], 0) + 1
        return True

    def refuses(self, peer: Address) -> bool:
        """Whether the operating system has answered that there is no socket at ``peer``, since it was last asked."""
        return peer in self._note_refusals(self.socket)

    def _note_refusals(self, source: socket.socket) -> set[Address]:
        """Take what the operating system says of datagrams that found no socket; return where they went to."""
        refused: set[Address] = set()
        for _ in range(_MAX_REFUSALS):
            try:
                _, _, _, peer = source.recvmsg(1, 1, socket.MSG_ERRQUEUE)
            except OSError:  # there is no more
                break
            refused.add(peer)
        for link in map(self._links.get, refused):
            if link is not None:
                link.refused()
        return refused

    def warn(self, kind: str, text: str, now_us: int, name: str = "") -> None:
        """Log a warning, at most one of each ``kind`` a simulated second and a wall second."""
        if self._may_warn(kind, now_us):
            self._warned[kind] = now_us, time.monotonic()
            _log.warning("%s: %s", name or self.name, text)

    def _may_warn(self, kind: str, now_us: int) -> bool:
        """Return whether the last warning of a kind is long enough ago."""
        last = self._warned.get(kind)
        if last is None:
            return True
        return now_us - last[0] >= _WARNING_INTERVAL_US and time.monotonic() - last[1] >= _WARNING_INTERVAL_S
