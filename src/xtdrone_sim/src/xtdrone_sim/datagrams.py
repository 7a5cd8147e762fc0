"""MAVLink over UDP between the autopilots and lockstep participants: none must be missed, some may get lost."""

from __future__ import annotations

import time
from collections.abc import Callable

from xtdrone_control.lockstep.server import LockstepServer
from xtdrone_control.mavlink.server import MavlinkServer

LIMIT = 10.0  # s of wall time to wait for datagrams that a participant of this machine says it has sent
REMOTE_LIMIT = 0.25  # the same for one of another machine: on the way from there some get lost
_SLICE = 0.01  # s
_SURPLUS_TURNS = 50
_REPORT_PERIOD = 1.0  # s of wall time between two words on lost datagrams


class Datagrams:
    """Waits for what participants have sent, and sees to it that the autopilots send where participants are."""

    def __init__(self, mavlink: MavlinkServer, server: LockstepServer, warn: Callable[[str], None]) -> None:
        """Start with nothing lost.

        Args:
            mavlink: counts what comes.
            server: tells what participants have sent, and where they are.
            warn: takes a warning for the user.
        """
        self._mavlink = mavlink
        self._server = server
        self._warn = warn
        self._directed: set[str] = set()
        self._lost: dict[int, int] = {}  # given up, by local port
        self._surplus: dict[int, tuple[int, int]] = {}  # for how many turns, and the least of it
        self._unreported: dict[int, int] = {}
        self._reported = -_REPORT_PERIOD

    def direct(self) -> None:
        """Point links at participants on other machines: what is sent before these speak would go astray else."""
        for name, participant in self._server.participants.items():
            if participant.udp_ports and name not in self._directed and participant.remote():
                self._directed.add(name)
                self._mavlink.direct(participant.udp_ports, participant.address.rpartition(":")[0])

    def wait(self) -> None:
        """Take in what participants say they have sent by now; what does not come in time is reported as lost."""
        began = time.monotonic()
        while missing := self._missing():
            waited = time.monotonic() - began
            for port, count in missing.items():
                if waited >= (REMOTE_LIMIT if self._server.remote_sender(port) else LIMIT):
                    self._lost[port] = self._lost.get(port, 0) + count
                    self._unreported[port] = self._unreported.get(port, 0) + count
            self._mavlink.receive(_SLICE)
        if self._lost:
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

    def _take_back(self) -> None:
        """Lower the number of lost datagrams when some of them have come late.

        Else they would be taken for those that are still to come. A surplus that passes is none: it is what was sent
        but had not been counted yet.
        """
        received, expected = self._mavlink.received, self._server.datagrams_expected
        for port, lost in self._lost.items():
            surplus = received.get(port, 0) + lost - expected[port]
            turns, least = self._surplus.get(port, (0, surplus))
            least = min(least, surplus)
            if least <= 0:
                self._surplus.pop(port, None)
            elif turns < _SURPLUS_TURNS:
                self._surplus[port] = turns + 1, least
            else:
                self._lost[port] -= min(least, lost)
                del self._surplus[port]

    def _report(self) -> None:
        now = time.monotonic()
        if not self._unreported or now - self._reported < _REPORT_PERIOD:
            return
        self._reported = now
        for port, count in sorted(self._unreported.items()):
            self._warn(f"{count} datagrams to UDP port {port} did not come; {self._lost[port]} are lost so far")
        self._unreported.clear()
