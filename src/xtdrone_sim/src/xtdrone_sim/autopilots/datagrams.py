"""MAVLink over UDP between the autopilots and lockstep participants: none must be missed, some may get lost."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from xtdrone_control.lockstep.server import LockstepServer
from xtdrone_control.mavlink.port import LOOPBACK
from xtdrone_control.mavlink.server import MavlinkServer

LIMIT = 10.0  # s of wall time to wait for datagrams that a participant of this machine says it has sent
REMOTE_LIMIT = 0.25  # the same for one of another machine: on the way from there some get lost
_SLICE = 0.01  # s
_LONGEST = 1.0  # s that one such wait counts for at most: beyond, this process was stopped, and the sender perhaps too
_SURPLUS_TURNS = 50
_REPORT_PERIOD = 1.0  # s of wall time between two words on lost datagrams


class _End(NamedTuple):
    """A participant that receives on some port: its name, host and port of its connection, whether it is elsewhere."""

    name: str
    address: str
    remote: bool


class Datagrams:
    """Waits for what participants have sent, and sees to it that the autopilots send where participants are."""

    def __init__(
        self,
        mavlink: MavlinkServer,
        server: LockstepServer,
        warn: Callable[[str], None],
        idle: Callable[[float], None],
    ) -> None:
        """Start with nothing lost.

        Args:
            mavlink: counts what comes.
            server: tells what participants have sent, and where they are.
            warn: takes a warning for the user.
            idle: called with a time in wall seconds instead of a plain wait: receives what comes by MAVLink, serves
                everything else but ``server``, and raises when the node is to end.
        """
        self._mavlink = mavlink
        self._server = server
        self._warn = warn
        self._idle = idle
        self._ends: dict[int, _End] = {}  # by port, whom the links have been pointed at
        self._known: set[_End] = set()
        # By local port, what will not come any more; below 0: so many have come that nobody has counted.
        self._lost: dict[int, int] = {}
        self._surplus: dict[int, tuple[int, int]] = {}  # for how many turns, and the least of it
        self._unreported: dict[int, int] = {}
        self._reported = -_REPORT_PERIOD

    def direct(self) -> None:
        """Have sockets for participants, and point links at those on other machines.

        What is sent before these speak would go astray else. A participant that takes the place of one that is gone
        gets what went there, wherever either of them is.
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

    def _reserve(self, present: Mapping[_End, Iterable[int]]) -> None:
        """Have a socket for every address from which participants send."""
        peers: dict[int, set[str]] = {}
        for end, ports in present.items():
            hosts = {end.address.rpartition(":")[0]} | (set() if end.remote else {LOOPBACK})
            for port in ports:
                peers.setdefault(port, set()).update(hosts)
        self._mavlink.reserve(peers)

    def _point(self, port: int, end: _End) -> None:
        """Let the links to ``port`` send to a participant, unless another one that is there still has it."""
        before = self._ends.get(port)
        if before in self._known:
            return
        self._ends[port] = end
        if end.remote:
            self._mavlink.direct([port], end.address.rpartition(":")[0], override=before is not None)
        elif before is not None and before.remote:
            self._mavlink.direct([port], LOOPBACK, override=True)

    def counted_ports(self) -> set[int]:
        """Return the ports on which participants count what comes from the simulator."""
        return {port for participant in self._server.participants.values() for port in participant.udp_ports}

    def wait(self) -> None:
        """Take in what participants say they have sent by now; what does not come in time is reported as lost.

        What was sent on this machine is in the sockets already. So it is read here in any case, also if strangers'
        datagrams have upset the counts.
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
        """Return how many datagrams are on their way to each local port, where there are any."""
        received, lost = self._mavlink.received, self._lost
        missing = {}
        for port, count in self._server.datagrams_expected.items():
            away = count - received.get(port, count) - lost.get(port, 0)
            if away > 0:
                missing[port] = away
        return missing

    def _limit(self, port: int) -> float:
        # As many have come as were counted, and it is only thought that some of them are a stranger's.
        doubtful = self._mavlink.received[port] >= self._server.datagrams_expected[port]
        return REMOTE_LIMIT if doubtful or self._server.remote_sender(port) else LIMIT

    def _give_up(self, port: int, count: int) -> None:
        before = self._lost.get(port, 0)
        self._lost[port] = before + count
        lost = max(self._lost[port], 0) - max(before, 0)
        if lost:
            self._unreported[port] = self._unreported.get(port, 0) + lost

    def _take_back(self) -> None:
        """Lower the number of lost datagrams when some of them have come late, or others that nobody has counted.

        Else they would be taken for those that are still to come. A surplus that passes is none: it is what was sent
        but had not been counted yet.
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
            self._warn(f"{count} datagrams to UDP port {port} did not come; {lost} are lost so far")
        self._unreported.clear()
