"""MAVLink over UDP between autopilots and lockstep participants: waits for every datagram, or reports it lost."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from xtdrone_autopilot.mavlink.mavlink_server import MavlinkServer
from xtdrone_autopilot.mavlink.udp_port_and_clients import LOOPBACK
from xtdrone_lockstep.server import LockstepServer

LIMIT = 10.0  # wall s to wait for datagrams that a participant on this machine has reported as sent
REMOTE_LIMIT = 0.25  # the same for a participant on another machine, because the network loses datagrams
_SLICE = 0.01  # s
_LONGEST = 1.0  # s, cap on one measured wait: a longer one means this process was suspended, perhaps the sender too
_SURPLUS_TURNS = 50
_REPORT_PERIOD = 1.0  # wall s between two warnings about lost datagrams


class _End(NamedTuple):
    """A participant that receives on a UDP port.

    Attributes:
        name: name of the participant.
        address: ``host:port`` of its lockstep connection.
        remote: whether it runs on another machine.
    """

    name: str
    address: str
    remote: bool


class Datagrams:
    """Receives the datagrams of all participants before the barrier opens, and routes the autopilots' links to them."""

    def __init__(
        self, mavlink: MavlinkServer, server: LockstepServer, warn: Callable[[str], None], idle: Callable[[float], None]
    ) -> None:
        """Start with no datagram lost.

        Args:
            mavlink: receives and counts the datagrams.
            server: provides the counts of sent datagrams and the addresses of the participants.
            warn: logs a warning.
            idle: waits up to the given wall time, s: receives MAVLink, serves everything else except ``server``, and
                raises when the node shuts down.
        """
        self._mavlink = mavlink
        self._server = server
        self._warn = warn
        self._idle = idle
        self._ends: dict[int, _End] = {}  # by port, the participant to which the links send
        self._known: set[_End] = set()
        # By local port, the number of lost datagrams; negative: received datagrams that no participant has counted.
        self._lost: dict[int, int] = {}
        self._surplus: dict[int, tuple[int, int]] = {}  # by local port: consecutive turns with a surplus, its minimum
        self._unreported: dict[int, int] = {}
        self._reported = -_REPORT_PERIOD

    def direct(self) -> None:
        """Open sockets for the participants, and point links at those on other machines.

        Without this, data sent to a remote participant before its first datagram would be lost. A participant that
        replaces a disconnected one on the same port takes over its links, on whichever machine either of them runs.
        """
        present = {
            _End(name, participant.address, participant.remote): participant.udp_ports
            for name, participant in self._server.participants.items()
            if participant.udp_ports
        }
        if present.keys() == self._known:
            return
        self._known = set(present)
        self._reserve(present)
        for end, ports in present.items():
            for port in ports:
                self._point(port, end)

    def ports_changed(self) -> None:
        """Open the sockets for participants again: a vehicle has joined."""
        self._known = set()

    def _reserve(self, present: Mapping[_End, Iterable[int]]) -> None:
        """Open a socket for every address from which participants send."""
        peers: dict[int, set[str]] = {}
        for end, ports in present.items():
            hosts = {end.address.rpartition(":")[0]} | (set() if end.remote else {LOOPBACK})
            for port in ports:
                peers.setdefault(port, set()).update(hosts)
        self._mavlink.reserve(peers)

    def _point(self, port: int, end: _End) -> None:
        """Point the links to ``port`` at a participant, unless another connected participant holds the port."""
        before = self._ends.get(port)
        if before in self._known:
            return
        self._ends[port] = end
        if end.remote:
            self._mavlink.direct([port], end.address.rpartition(":")[0], override=before is not None)
        elif before is not None and before.remote:
            self._mavlink.direct([port], LOOPBACK, override=True)

    def counted_ports(self) -> set[int]:
        """Return the ports on which participants count the datagrams of the simulator."""
        return {port for participant in self._server.participants.values() for port in participant.udp_ports}

    def wait(self) -> None:
        """Receive all datagrams that participants have reported as sent; report those that time out as lost.

        Datagrams sent on this machine are already in the sockets. They are read unconditionally, so they arrive even
        if datagrams of other senders have upset the counts.
        """
        self._mavlink.receive(0.0)
        waited, looked = 0.0, time.monotonic()
        while missing := self._missing():
            for port, count in missing.items():
                if waited >= self._limit(port):
                    self._give_up(port, count)
            self._idle(_SLICE)
            self._server.poll(0.0)
            now = time.monotonic()
            waited, looked = waited + min(now - looked, _LONGEST), now
        self._take_back()
        self._report()

    def _missing(self) -> dict[int, int]:
        """Return the number of datagrams in flight by local port, for ports with at least one."""
        received, lost = self._mavlink.received, self._lost
        missing = {}
        for port, count in self._server.datagrams_expected.items():
            away = count - received.get(port, count) - lost.get(port, 0)
            if away > 0:
                missing[port] = away
        return missing

    def _limit(self, port: int) -> float:
        # Enough datagrams have arrived; the count is short only because some are presumed to be from other senders.
        doubtful = self._mavlink.received[port] >= self._server.datagrams_expected[port]
        return REMOTE_LIMIT if doubtful or self._server.remote_sender(port) else LIMIT

    def _give_up(self, port: int, count: int) -> None:
        before = self._lost.get(port, 0)
        self._lost[port] = before + count
        lost = max(self._lost[port], 0) - max(before, 0)
        if lost:
            self._unreported[port] = self._unreported.get(port, 0) + lost

    def _take_back(self) -> None:
        """Lower the number of lost datagrams after late or uncounted ones have arrived.

        Otherwise these would be mistaken for datagrams that are still in flight. A surplus that lasts less than
        ``_SURPLUS_TURNS`` turns is ignored: it consists of datagrams sent but not counted yet.
        """
        received, expected = self._mavlink.received, self._server.datagrams_expected
        for port, count in expected.items():
            surplus = received.get(port, count) + self._lost.get(port, 0) - count
            if surplus <= 0:
                self._surplus.pop(port, None)
                continue
            turns, least = self._surplus.get(port, (0, surplus))
            least = min(least, surplus)
            if turns < _SURPLUS_TURNS:
                self._surplus[port] = turns + 1, least
            else:
                self._lost[port] = self._lost.get(port, 0) - least
                del self._surplus[port]

    def _report(self) -> None:
        now = time.monotonic()
        if not self._unreported or now - self._reported < _REPORT_PERIOD:
            return
        self._reported = now
        for port, count in sorted(self._unreported.items()):
            lost = max(self._lost[port], 0)
            self._warn(f"{count} datagrams to UDP port {port} did not arrive; {lost} are lost so far")
        self._unreported.clear()
