"""What the lockstep's server knows of one participant, of its process and of its topic connections."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping
from typing import Any

from .frames import AFTER_JOIN, BEFORE_JOIN
from .protocol import FrameReader, Schedule, same_machine

Pair = tuple[str, str, str]
"""Topic, publisher's name, subscriber's name."""
NEWS_A_FRAME = 8192
"""Most connections in one PEER frame, which is thus shorter than `protocol.MAX_FRAME` by far."""


class Channel:
    """One topic connection between two participants.

    Attributes:
        id: The server's number.
        pair: Topic, publisher, subscriber.
        port: The subscriber's TCP port, which tells two connections of the same pair apart.
    """

    __slots__ = ("id", "pair", "port")

    def __init__(self, number: int, pair: Pair, port: int) -> None:
        """Keeps what identifies it."""
        self.id = number
        self.pair = pair
        self.port = port


class Process:
    """A process of this machine, told apart from a later one with the same number."""

    def __init__(self, pid: int) -> None:
        """Notes which it is.

        Args:
            pid: Of a process that runs.
        """
        self.pid = pid
        self._began = self._stat()[1]

    def state(self) -> str:
        """Returns the kernel's letter for its state (``t``: held by a debugger), empty if the process is gone."""
        state, began = self._stat()
        return "" if began != self._began or state in "ZX" else state

    def _stat(self) -> tuple[str, str]:
        try:
            with open(f"/proc/{self.pid}/stat", encoding="ascii", errors="replace") as file:
                # Fields 3 and 22 of proc(5); the second, the program's name, may hold anything.
                fields = file.read().rpartition(")")[2].split()
        except OSError:
            return "", ""
        return fields[0], fields[19]


class Participant:
    """What the server knows of one participant.

    Attributes:
        name: Resolved ROS name, as /follower_1; empty until it joined.
        remote: True if it runs on another machine.
        reserved: The name that it has reserved, empty if none.
        host: Address of its machine.
        address: Host and port of its connection.
        rate: In Hz; 0 for the simulator itself.
        due_us: When its next turn is.
        waiting: True from TICK to DONE.
        needs_time: True while it waits for what comes only when time goes on.
        tick: Number of its last TICK.
        heard: Monotonic wall time at which something was last received from it, s.
        asked: Monotonic wall time of its last TICK, s.
        accepted: Monotonic wall time at which it connected or reserved its name, s.
        process: Its process, if that runs on this machine.
        udp_ports: Local ports on which it receives the simulator's datagrams.
    """

    def __init__(self, sock: socket.socket | None, address: tuple[str, int], now: float) -> None:
        """Makes one that has not joined.

        Args:
            sock: Its connection; None for the simulator itself.
            address: The connection's other end.
            now: Monotonic wall time, s.
        """
        self.sock = sock
        self.host = address[0]
        self.address = f"{address[0]}:{address[1]}" if sock is not None else address[0]
        self.name = ""
        self.remote = sock is not None and not same_machine(address[0], sock.getsockname()[0])
        self.reserved = ""
        self.rate = 0.0
        self.schedule: Schedule | None = None
        self.due_us = 0
        self.waiting = False
        self.needs_time = False
        self.tick = 0
        self.heard = now
        self.asked = now
        self.accepted = now
        self.process: Process | None = None
        self.udp_ports: tuple[int, ...] = ()
        self.reader = FrameReader(BEFORE_JOIN)
        self.unsent = bytearray()
        # Its own connections as publisher: id -> channel, and id -> (news of the subscriber, id there) for new counts;
        # those that are no more, whose last counts come with its next DONE.
        self.channels: dict[int, Channel] = {}
        self.routes: dict[int, tuple[dict[int, int], int]] = {}
        self.closing: list[int] = []
        self.counted: list[int] = []
        self.uncounted: list[int] = []
        # News for it as subscriber, sent with its next TICK; how many connections are new from each publisher.
        self.new: dict[str, int] = {}
        self.counts: dict[int, int] = {}
        self.made: list[list[Any]] = []
        self.lost: list[int] = []
        self.reset = False
        self.void: list[list[int]] = []
        # UDP: told and base count the simulator's datagrams to it, sent counts its own per remote port.
        self.datagrams_base: dict[int, int] = {}
        self.datagrams_told: dict[int, int] = {}
        self.datagrams_sent: dict[int, int] = {}

    def connected(self) -> bool:
        """Says whether its connection is open."""
        return self.sock is not None

    def join(self, name: str, rate: float, schedule: Schedule) -> None:
        """Becomes a participant.

        Args:
            name: Resolved ROS name.
            rate: In Hz.
            schedule: The times of its turns.
        """
        self.name, self.rate, self.schedule = name, rate, schedule
        self.reader.longest = AFTER_JOIN

    def take_news(self) -> list[dict[str, Any]]:
        """Returns what is to be told by PEER frames, each one's content, and forgets it.

        What was made comes before what was lost; a frame has at most `NEWS_A_FRAME` entries of each kind.
        """
        first: dict[str, list[Any]] = {"made": self.made, "counted": self.counted}
        then: dict[str, list[Any]] = {"lost": self.lost, "uncounted": self.uncounted}
        if self.reset:
            then["void"] = self.void
        elif not any((*first.values(), *then.values())):
            return []
        if all(len(entries) <= NEWS_A_FRAME for entries in (*first.values(), *then.values())):
            contents: list[dict[str, Any]] = [{**first, **then}]
        else:
            contents = [*_pieces(first), *_pieces(then)]
        if self.reset:
            contents[-1]["reset"] = True
        self.made, self.lost, self.counted, self.uncounted, self.void = [], [], [], [], []
        self.reset = False
        self.new.clear()
        return [{"made": [], "lost": [], "counted": [], "uncounted": [], **content} for content in contents]


def _pieces(lists: Mapping[str, list[Any]]) -> Iterator[dict[str, Any]]:
    for at in range(0, max(map(len, lists.values())), NEWS_A_FRAME):
        yield {name: entries[at : at + NEWS_A_FRAME] for name, entries in lists.items()}
