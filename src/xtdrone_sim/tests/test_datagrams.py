"""Waiting for MAVLink datagrams of participants on this machine and on others."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from xtdrone_sim.autopilots import datagrams
from xtdrone_sim.autopilots.datagrams import Datagrams
from xtdrone_sim.runtime.simulator_node import reachable_uri

PORT = 34580


@dataclass
class Participant:
    address: str
    remote: bool
    udp_ports: list[int] = field(default_factory=lambda: [24540, 24541])


@dataclass
class Server:
    """Fake server: reports the datagrams sent by participants."""

    away: bool = False
    datagrams_expected: dict[int, int] = field(default_factory=dict)
    participants: dict[str, Participant] = field(default_factory=dict)
    polls: int = 0

    def poll(self, timeout: float) -> None:
        assert timeout == 0.0
        self.polls += 1

    def remote_sender(self, port: int) -> bool:
        assert port == PORT
        return self.away


@dataclass
class Mavlink:
    """Receives the datagrams in its socket; those on the way arrive one at a time."""

    received: dict[int, int] = field(default_factory=lambda: {PORT: 0})
    in_socket: int = 0
    under_way: int = 0
    directed: list[tuple[list[int], str, bool]] = field(default_factory=list)
    reserved: list[dict[int, set[str]]] = field(default_factory=list)

    def receive(self, timeout: float) -> int:
        assert timeout == 0.0
        came, self.in_socket = self.in_socket, 0
        self.received[PORT] += came
        return came

    def let_one_come(self) -> None:
        came = min(1, self.under_way)
        self.under_way -= came
        self.in_socket += came

    def reserve(self, peers: dict[int, set[str]]) -> None:
        self.reserved.append(peers)

    def direct(self, ports: list[int], host: str, *, override: bool) -> None:
        self.directed.append((ports, host, override))


class Rig:
    """The waiting between a simulated server and simulated sockets, with a clock that only the waiting advances."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, away: bool) -> None:
        self.now = 0.0
        self.server, self.mavlink, self.warnings = Server(away), Mavlink(), []
        self.stopping = False
        self.datagrams = Datagrams(self.mavlink, self.server, self.warnings.append, self.idle)  # type: ignore[arg-type]
        monkeypatch.setattr(datagrams.time, "monotonic", self._time)

    def _time(self) -> float:
        self.now += 0.01
        return self.now

    def idle(self, timeout: float) -> None:
        assert timeout > 0.0
        if self.stopping:
            raise KeyboardInterrupt
        self.mavlink.let_one_come()
        self.mavlink.receive(0.0)

    def turn(self, sent: int, lost: int = 0, early: bool = False) -> float:
        """Send datagrams as a participant; return the time the simulator waited for them, s.

        Args:
            sent: how many.
            lost: how many of them get lost on the way.
            early: whether they arrive while the simulator still waits for the participant's turn to end.
        """
        self.server.datagrams_expected[PORT] = self.server.datagrams_expected.get(PORT, 0) + sent
        self.mavlink.under_way += sent - lost
        while early and self.mavlink.under_way:
            self.idle(0.1)
        began = self.now
        self.datagrams.wait()
        return self.now - began


@pytest.mark.parametrize(("away", "limit"), [(True, datagrams.REMOTE_LIMIT), (False, datagrams.LIMIT)])
def test_lost_datagrams_are_waited_for_once_and_reported(monkeypatch, away, limit):
    rig = Rig(monkeypatch, away)
    assert rig.turn(sent=3) < 0.1
    assert rig.warnings == []
    assert limit <= rig.turn(sent=3, lost=2) < limit + 0.1
    assert rig.warnings == [f"2 datagrams to UDP port {PORT} did not arrive; 2 are lost so far"]
    assert rig.turn(sent=3) < 0.1
    assert rig.mavlink.received[PORT] == 7


def test_a_stop_of_all_processes_is_no_loss(monkeypatch):
    rig = Rig(monkeypatch, away=False)
    idle = rig.idle

    def stopped(timeout: float) -> None:
        if rig.mavlink.under_way == 3:
            rig.now += 70.0
        if rig.now > 71.0:
            idle(timeout)

    monkeypatch.setattr(rig.datagrams, "_idle", stopped)
    assert rig.turn(sent=3) > 70.0
    assert rig.mavlink.received[PORT] == 3
    assert rig.turn(sent=1) < 0.1
    assert rig.warnings == []


def test_reports_are_throttled_and_complete(monkeypatch):
    rig = Rig(monkeypatch, away=True)
    for _ in range(3):
        rig.turn(sent=2, lost=1)
    assert len(rig.warnings) == 1
    rig.now += 1.0
    rig.turn(sent=1)
    assert rig.warnings[1:] == [f"2 datagrams to UDP port {PORT} did not arrive; 3 are lost so far"]


def test_late_replies_are_not_matched_to_later_requests(monkeypatch):
    rig = Rig(monkeypatch, away=True)
    rig.turn(sent=5, lost=2)
    rig.mavlink.received[PORT] += 1  # one of the two was only delayed
    rig.turn(sent=1)
    assert rig.mavlink.under_way == 1  # the late one is counted as this one
    for _ in range(100):
        rig.turn(sent=1, early=True)
    rig.turn(sent=1)
    assert rig.mavlink.under_way == 0
    assert rig.turn(sent=1, lost=1) >= datagrams.REMOTE_LIMIT
    assert rig.mavlink.received[PORT] == 106


def test_uncounted_messages_are_not_late(monkeypatch):
    rig = Rig(monkeypatch, away=True)
    rig.turn(sent=5, lost=1)
    for _ in range(200):
        rig.mavlink.received[PORT] += 1  # a thread of the participant has sent it after the count
        rig.turn(sent=0)
        rig.mavlink.under_way -= 1
        rig.turn(sent=1)
    assert len(rig.warnings) == 1


def test_the_sockets_are_read_empty_for_every_count(monkeypatch):
    rig = Rig(monkeypatch, away=False)
    rig.mavlink.received[PORT] = 7  # a stranger's datagram
    rig.mavlink.in_socket = 1
    assert rig.turn(sent=0) < 0.1
    assert rig.mavlink.received[PORT] == 8


def test_a_strangers_datagrams_upset_the_counts_for_a_while_only(monkeypatch):
    rig = Rig(monkeypatch, away=True)
    rig.turn(sent=1)
    rig.mavlink.received[PORT] += 3
    rig.turn(sent=1)
    assert rig.mavlink.under_way == 1  # mistaken for one of the three
    for _ in range(120):
        rig.turn(sent=1, early=True)
    rig.turn(sent=1)
    assert rig.mavlink.under_way == 0
    assert rig.warnings == []


def test_a_false_surplus_delays_once(monkeypatch):
    rig = Rig(monkeypatch, away=False)
    rig.turn(sent=1)
    rig.mavlink.received[PORT] += 1  # sent after each turn, and counted in the next
    for _ in range(100):
        rig.turn(sent=1, early=True)
    rig.server.datagrams_expected[PORT] += 1
    assert datagrams.REMOTE_LIMIT <= rig.turn(sent=0) < datagrams.REMOTE_LIMIT + 0.1
    assert rig.turn(sent=1) < 0.1
    assert rig.mavlink.under_way == 0
    assert rig.warnings == []  # nothing is lost


def test_a_stop_and_the_lockstep_are_served_while_waiting(monkeypatch):
    rig = Rig(monkeypatch, away=False)
    rig.turn(sent=2)
    assert rig.server.polls == 2
    rig.stopping = True
    with pytest.raises(KeyboardInterrupt):
        rig.turn(sent=1, lost=1)


def test_links_point_at_participants_on_other_machines_once(monkeypatch):
    rig = Rig(monkeypatch, away=True)
    rig.server.participants = {
        "/mavros": Participant("10.0.0.2:4711", True),
        "/here": Participant("127.0.0.1:4712", False),
        "/deaf": Participant("10.0.0.3:4713", True, []),
    }
    rig.datagrams.direct()
    rig.datagrams.direct()
    assert rig.mavlink.directed == [([24540], "10.0.0.2", False), ([24541], "10.0.0.2", False)]
    here = {"10.0.0.2", "127.0.0.1"}
    assert rig.mavlink.reserved == [{24540: here, 24541: here}]
    assert rig.datagrams.counted_ports() == {24540, 24541}


def test_links_follow_a_participant_that_returns_at_another_address(monkeypatch):
    rig = Rig(monkeypatch, away=True)
    for participant in (
        Participant("127.0.0.1:4710", False, [24540]),
        Participant("10.0.0.2:4711", True, [24540]),
        Participant("10.0.0.3:4711", True, [24540]),
        Participant("127.0.0.1:4712", False, [24540]),
        Participant("127.0.0.1:4713", False, [24540]),
    ):
        rig.server.participants = {"/mavros": participant}
        rig.datagrams.direct()
        rig.datagrams.direct()
    assert rig.mavlink.directed == [
        ([24540], "10.0.0.2", True),
        ([24540], "10.0.0.3", True),
        ([24540], "127.0.0.1", True),
    ]


def test_a_port_belongs_to_its_first_client_while_connected(monkeypatch):
    rig = Rig(monkeypatch, away=True)
    first, second = Participant("10.0.0.2:1", True, [24540]), Participant("10.0.0.3:1", True, [24540])
    rig.server.participants = {"/first": first}
    rig.datagrams.direct()
    rig.server.participants = {"/first": first, "/second": second}
    rig.datagrams.direct()
    assert rig.mavlink.directed == [([24540], "10.0.0.2", False)]
    rig.server.participants = {"/second": second}
    rig.datagrams.direct()
    assert rig.mavlink.directed[1:] == [([24540], "10.0.0.3", True)]


def test_remote_participants_get_a_reachable_address(monkeypatch):
    monkeypatch.setenv("ROS_IP", "10.1.2.3")
    monkeypatch.delenv("ROS_HOSTNAME", raising=False)
    assert reachable_uri("tcp://anything:4711", "0.0.0.0") == "tcp://10.1.2.3:4711"
    assert reachable_uri("tcp://10.9.9.9:4711", "10.9.9.9") == "tcp://10.9.9.9:4711"
