"""One UDP port of one vehicle, and its clients.

The address of the first client is configured: as in PX4, the port streams to it from the start and never removes it.
While the operating system reports that no socket is bound there, only heartbeats are sent. Every other sender becomes a
client with a separate link, up to ``MAX_CLIENTS`` on the port, and is removed after 5 s of silence. New senders beyond
that limit get no reply; no existing client is removed for them.

A lockstep participant has a reserved socket (``reserve``), connected to its address. Its datagrams have a separate
buffer, which other senders cannot fill, and are handled on arrival. For all other senders see ``rate_limit``.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field

from xtdrone_native.mavlink_wire import INTERRUPTED, Outbox, receive

from xtdrone_autopilot.mavlink.streams.stream_schedule import Payloads
from xtdrone_autopilot.mavlink.streams.telemetry import Telemetry, silent
from xtdrone_common.fleet import Vehicle

from .client_link import Address, Link

LOOPBACK = "127.0.0.1"
MAX_CLIENTS = 16  # on one port
CLIENTS = 16  # on all ports of a server, not counting the first client of each,
VEHICLE_CLIENTS = 2  # plus this many for each vehicle: streams to them cost the simulator time
_MAX_COUNTS = 256  # remote ports whose datagrams are counted; lockstep participants may reconnect from theirs
_MAX_REFUSALS = 4096  # read in one call
_LARGEST_DATAGRAM = 8192  # longer ones are truncated, as by PX4
_RECEIVE_BUFFER = 1 << 20
_WARNING_INTERVAL_US = 1_000_000
_WARNING_INTERVAL_S = 1.0
_CLEANUP_INTERVAL_S = 0.1
_IP_RECVERR = 11  # Linux: queue ICMP errors with the address that they came from
_ICMP_ERRORS = (errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.EPROTO)

_log = logging.getLogger("rosout.mavlink")


class LinkError(OSError):
    """A link whose port cannot be bound."""


def _share(sockets: Iterable[socket.socket], value: int) -> None:
    """Allow (1) or forbid (0) further binds to the port of ``sockets``; existing binds are kept."""
    for one in sockets:
        if one.fileno() != -1:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, value)


@dataclass
class ClientLimit:
    """Limit of the number of clients on several ports together.

    Attributes:
        left: number of further clients allowed, the first client of each port not counted.
        ports: ports that share the limit.
    """

    left: int
    ports: list[Port] = field(default_factory=list)
    _next_check: float = 0.0

    def remove_silent(self, now_us: int) -> None:
        """Remove silent clients of all ports, at most every 0.1 s of wall time, even if simulated time stands still."""
        wall = time.monotonic()
        if wall >= self._next_check:
            self._next_check = wall + _CLEANUP_INTERVAL_S
            for port in self.ports:
                port.remove_silent(now_us)
                if port.by_wall:
                    port.remove_silent(now_us, by_wall_alone=True)


class Port:
    """The autopilot's end of MAVLink over one UDP port.

    Attributes:
        name: vehicle and kind of link, for log messages.
        system_id: the vehicle's MAVLink system id.
        local_port: bound port.
        remote_port: port of the first client.
        default: the link to the first client.
        telemetry: source of the vehicle's telemetry messages.
        rates: default rates of the streams, message name to Hz.
        data_rate: nominal capacity of the link, bytes/s, as PX4 is started with; nothing is throttled to it.
        by_wall: whether clients run on wall time, as a ground station does: a client is silent only when it is silent
            by both clocks. Otherwise simulated time alone counts, so that the streams are the same at any speed.
            received: datagrams read.
        sent: datagrams sent, by remote port.
        lost: datagrams that the operating system did not accept.
        malformed: datagrams with bytes that are not valid MAVLink.
        foreign: messages for other systems.
        dropped: datagrams dropped because their sender's queue was full, see ``rate_limit``.
        refused: messages of new senders beyond the client limit.
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
        data_rate: int = 4_000_000,
        by_wall: bool = False,
        limit: ClientLimit | None = None,
        totals: dict[int, int] | None = None,
        due_changed: Callable[[], None] = silent,
    ) -> None:
        """Bind the port.

        Args:
            vehicle: vehicle that the port belongs to.
            kind: name of the link in log messages.
            local_port: port to bind.
            remote_port: port of the first client, on this machine unless ``direct`` sets another host.
            telemetry: source of the vehicle's telemetry messages.
            rates: default rates of the streams, message name to Hz.
            host: address to bind; "0.0.0.0" for every network.
            data_rate: see the attribute.
            by_wall: see the attribute.
            limit: client limit shared with other ports; ``MAX_CLIENTS`` by default.
            totals: sum of ``sent`` of all ports that share it; updated.
            due_changed: called when ``next_due_us`` may have changed.

        Raises:
            LinkError: the port cannot be bound, or ``host`` is not an address of this machine.
        """
        self.name = f"{vehicle.name} {kind} link"
        self.system_id = vehicle.system_id
        self.local_port = local_port
        self.remote_port = remote_port
        self.telemetry = telemetry
        self.rates = rates
        self.data_rate = data_rate
        self.by_wall = by_wall
        self.received = 0
        self.sent: dict[int, int] = {}
        self._totals = {} if totals is None else totals
        self.lost = 0
        self.malformed = 0
        self.foreign = 0
        self.dropped = 0
        self.refused = 0
        self._warned: dict[str, tuple[int, float]] = {}
        self._limit = limit or ClientLimit(MAX_CLIENTS)
        self._next_due_us: int | None = None
        self._due_changed = due_changed
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
        self._limit.ports.append(self)

    def _first_client(self, peer: Address) -> Link:
        link = Link(self, peer, self.name)
        link.is_first = True
        return link

    @property
    def links(self) -> list[Link]:
        """The links to all clients: the first client, then the others in order of arrival."""
        return list(self._links.values())

    @property
    def first_version(self) -> int:
        """The MAVLink version for a client that has sent nothing yet (MAV_PROTO_VER)."""
        return 2 if self.telemetry.protocol == 2 else 1

    def version_for(self, spoken: int, before: int) -> int:
        """Return the MAVLink version to send to a client whose last frame had version ``spoken``.

        MAVLink 2 once the client has sent it, MAVLink 1 before. A real PX4 sends MAVLink 2 to all clients unless
        MAV_PROTO_VER is set otherwise, which a client limited to MAVLink 1 could not read. With MAV_PROTO_VER 1 all
        clients get MAVLink 1.

        Args:
            spoken: version of the client's last frame.
            before: version sent to it so far; 0 when this is its first frame.
        """
        if self.telemetry.protocol == 1:
            return 1
        return max(spoken, before)

    def close(self) -> None:
        """Close the links and sockets, and leave the common limit of clients."""
        for link in self._links.values():
            link.close()
        if self in self._limit.ports:
            self._limit.ports.remove(self)
            self._limit.left += len(self._links) - 1
        for reserved in self._reserved.values():
            reserved.close()
        self.socket.close()

    def reboot(self, telemetry: Telemetry, now_us: int) -> None:
        """Restart the streams for a rebooted autopilot; socket, clients and counters are kept.

        Args:
            telemetry: telemetry of the rebooted vehicle.
            now_us: simulated time, microseconds; it may have gone back.
        """
        self.telemetry = telemetry
        self._warned.clear()
        for link in self._links.values():
            link.reboot(telemetry, now_us)

    def direct(self, host: str, now_us: int, *, override: bool = False) -> None:
        """Set the host of the first client if that has sent nothing yet; ``override`` also replaces one that has."""
        if self.default.has_spoken and not override:
            return
        peer = (host, self.remote_port)
        if peer == self.default.peer:
            return
        others = [link for link in self._links.values() if link is not self.default]
        self.default.close()
        known = self._links.get(peer)
        if known is not None:
            self._limit.left += 1
        self.default = known or self._first_client(peer)
        self.default.name, self.default.is_first = self.name, True
        self._links = {peer: self.default, **{link.peer: link for link in others}}
        self._update_participation(now_us)
        self.streams_changed()

    # received datagrams

    def reserve(self, peers: Collection[Address], now_us: int) -> tuple[list[socket.socket], list[socket.socket]]:
        """Reserve a socket for each of ``peers``, and for no other address.

        An unreachable address gets no socket; a warning is logged when no address gets one.

        Args:
            peers: addresses of the lockstep participants.
            now_us: simulated time, microseconds.

        Returns:
            The new sockets, and the unreserved ones, which the caller reads until they are empty and then closes.
        """
        gone = [self._reserved.pop(peer) for peer in list(self._reserved) if peer not in peers]
        new, reason = [], ""
        for peer in peers:
            if peer in self._reserved:
                continue
            try:
                made = self._connected(peer)
            except OSError as error:
                reason = f"cannot reserve a socket for {peer[0]}:{peer[1]}: {error.strerror or error}"
                continue
            self._reserved[peer] = made
            new.append(made)
        self._participants = frozenset(peers)
        self._update_participation(now_us)
        if reason and not self._reserved:
            self.warn("reserve", reason, now_us)
        return new, gone

    def _update_participation(self, now_us: int) -> None:
        participates = self.default.peer in self._participants
        if participates != self.default.participant:
            self.default.set_participant(participates, now_us)

    def _connected(self, peer: Address) -> socket.socket:
        """Return a socket on the same port that is connected to ``peer`` and receives all its datagrams."""
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
            _share(sharing, 0)  # keeps other programs off the port
        return made

    def is_reserved(self, sender: Address) -> bool:
        """Return whether ``sender`` has a reserved socket."""
        return sender in self._reserved

    def read(self, source: socket.socket) -> tuple[list[tuple[bytes, Address]], bool]:
        """Read datagrams on one of the port's sockets.

        Returns:
            The datagrams with their senders, and whether more may be waiting.
        """
        while True:
            try:
                datagrams, more = receive(source.fileno(), _LARGEST_DATAGRAM)
            except OSError as error:
                if error.errno not in _ICMP_ERRORS:
                    raise
                self._note_refusals(source)  # of an earlier datagram
                continue
            self.received += len(datagrams)
            return datagrams, more

    def find_link(self, sender: Address) -> Link | None:
        """Return the link to ``sender`` if it is a client."""
        return self._links.get(sender)

    def count_bytes(self, sender: Address, size: int) -> None:
        """Count the ``size`` bytes of a handled datagram, if its sender is a client."""
        link = self._links.get(sender)
        if link is not None:
            link.received_bytes += size

    def drop(self, sender: Address, now_us: int) -> None:
        """Count a datagram of ``sender`` that is dropped because its queue is full."""
        self.dropped += 1
        link = self._links.get(sender)
        if link is not None:
            link.dropped += 1
        if not self._may_warn("flood", now_us):
            return
        source = "unknown senders send" if link is None else f"{sender[0]}:{sender[1]} sends"
        self.warn("flood", f"{source} more than can be served; {self.dropped} datagrams were dropped so far", now_us)

    def note_malformed(self, sender: Address) -> None:
        """Count a datagram of ``sender`` with bytes that are not valid MAVLink."""
        self.malformed += 1
        link = self._links.get(sender)
        if link is not None:
            link.malformed += 1

    def link_of(self, sender: Address, now_us: int) -> Link | None:
        """Return the link to ``sender``, which has sent a valid message; None if the client limit is reached."""
        link = self._links.get(sender)
        if link is not None:
            return link
        if len(self._links) >= MAX_CLIENTS or self._limit.left < 1:
            self._limit.remove_silent(now_us)
        if len(self._links) >= MAX_CLIENTS or self._limit.left < 1:
            self.refused += 1
            if not self._may_warn("room", now_us):
                return None
            clients = f"{MAX_CLIENTS} clients" if self._limit.left > 0 else "as many clients as all ports may have"
            self.warn("room", f"{sender[0]}:{sender[1]} is not served: there are already {clients}", now_us)
            return None
        self._limit.left -= 1
        link = Link(self, sender, f"{self.name} to {sender[0]}:{sender[1]}")
        self._links[sender] = link
        self.streams_changed()
        return link

    # sent datagrams

    def streams_changed(self) -> None:
        """Recompute ``next_due_us``: the due times of a link's streams, or the links, have changed."""
        self._next_due_us = None
        self._due_changed()

    @property
    def next_due_us(self) -> int:
        """Simulated time, microseconds, of the next telemetry message."""
        if self._next_due_us is None:
            self._next_due_us = min(link.streams.next_due_us for link in self._links.values())
        return self._next_due_us

    def send_due(self, now_us: int, shared: Payloads) -> None:
        """Send due telemetry and queued frames, and remove silent clients.

        Args:
            now_us: simulated time, microseconds.
            shared: see ``Streams.send_due``.
        """
        self.remove_silent(now_us)
        for link in self._links.values():
            link.send_due(now_us, shared)
        self.streams_changed()

    def remove_silent(self, now_us: int, *, by_wall_alone: bool = False) -> None:
        """Remove silent clients, except the first one.

        Args:
            now_us: simulated time, microseconds.
            by_wall_alone: ignore simulated time and judge by wall time alone.
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
            self._limit.left += 1
            self.streams_changed()
            self._forget_counts()

    def _forget_counts(self) -> None:
        """Bound the table of sent datagrams: remove the oldest counts of removed clients."""
        living = {link.peer[1] for link in self._links.values()}
        for port in [port for port in self.sent if port not in living][: max(len(self.sent) - _MAX_COUNTS, 0)]:
            rest = self._totals.get(port, 0) - self.sent.pop(port)
            if rest > 0:
                self._totals[port] = rest
            else:
                self._totals.pop(port, None)

    def keep_alive(self, now_us: int, counted: Collection[int]) -> None:
        """Send a HEARTBEAT, at most one in a wall second, to clients that are not at ``counted`` ports."""
        for link in self._links.values():
            if link.peer[1] not in counted:
                link.keep_alive(now_us)

    def flush(self, now_us: int) -> None:
        """Send queued frames."""
        for link in self._links.values():
            if link.waiting:
                link.flush(now_us)

    def flush_others(self, now_us: int, counted: Collection[int]) -> None:
        """Send queued frames to clients that are not at ``counted`` ports."""
        for link in self._links.values():
            if link.peer[1] not in counted:
                link.flush(now_us)

    def send(self, frames: Outbox, peer: Address, now_us: int) -> int:
        """Send ``frames`` to ``peer``, each in a datagram, and count them.

        Returns:
            Number of datagrams that the operating system did not accept.
        """
        lost, retried, descriptor = 0, False, self.socket.fileno()
        while frames:
            accepted, error = frames.send(descriptor)
            if accepted:
                self.sent[peer[1]] = self.sent.get(peer[1], 0) + accepted
                self._totals[peer[1]] = self._totals.get(peer[1], 0) + accepted
                retried = False
            if not error:
                break
            if error == INTERRUPTED or (error in _ICMP_ERRORS and not retried):
                self._note_refusals(self.socket)  # of an earlier datagram, to this or another client
                retried = True
                continue
            frames.drop()
            lost, retried = lost + 1, False
            self.warn("send", f"cannot send to {peer[0]}:{peer[1]}: {os.strerror(error)}", now_us)
        self.lost += lost
        return lost

    def refuses(self, peer: Address) -> bool:
        """Return whether the operating system has reported since the last call that ``peer`` has no socket."""
        return peer in self._note_refusals(self.socket)

    def _note_refusals(self, source: socket.socket) -> set[Address]:
        """Read ICMP errors of sent datagrams, notify the links concerned, and return the unreachable addresses."""
        refused: set[Address] = set()
        for _ in range(_MAX_REFUSALS):
            try:
                _, _, _, peer = source.recvmsg(1, 1, socket.MSG_ERRQUEUE)
            except OSError:  # the queue is empty
                break
            refused.add(peer)
        for link in map(self._links.get, refused):
            if link is not None:
                link.refused()
        return refused

    def warn(self, kind: str, text: str, now_us: int, name: str = "") -> None:
        """Log a warning, at most one of each ``kind`` in a simulated second and a wall second."""
        if self._may_warn(kind, now_us):
            self._warned[kind] = now_us, time.monotonic()
            _log.warning("%s: %s", name or self.name, text)

    def _may_warn(self, kind: str, now_us: int) -> bool:
        """Return whether the rate limit allows another warning of ``kind``."""
        last = self._warned.get(kind)
        if last is None:
            return True
        return now_us - last[0] >= _WARNING_INTERVAL_US and time.monotonic() - last[1] >= _WARNING_INTERVAL_S
