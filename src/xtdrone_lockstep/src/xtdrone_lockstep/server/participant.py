"""The server's record of one participant: its turns, its topic connections and the news for its next TICK."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from ..protocol import Schedule
from .client_process import ClientConnection

Pair = tuple[str, str, str]
"""Topic, publisher's name, subscriber's name."""
MOST_NEWS_PER_FRAME = 8192
"""Maximum number of connections in one PEER frame, which keeps it far below ``protocol.MAX_FRAME``."""


class Channel:
    """One topic connection between two participants.

    Attributes:
        id: Number assigned by the server.
        pair: Topic, publisher, subscriber.
        port: The subscriber's TCP port, which distinguishes connections of the same pair.
    """

    __slots__ = ("id", "pair", "port")

    def __init__(self, number: int, pair: Pair, port: int) -> None:
        self.id = number
        self.pair = pair
        self.port = port


class Outgoing:
    """A participant's topic connections as publisher, by its own numbers.

    Attributes:
        channels: The open connections.
        routes: Where new counts go: the subscriber's ``News.counts`` and the channel's id in it.
        closing: Numbers of closed connections, whose last counts arrive with the next DONE.
    """

    def __init__(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.routes: dict[int, tuple[dict[int, int], int]] = {}
        self.closing: list[int] = []

    def forget_closed(self) -> None:
        """Remove the routes of closed connections."""
        for number in self.closing:
            self.routes.pop(number, None)
        self.closing.clear()


class News:
    """Changes to be sent to a participant with its next TICK.

    Attributes:
        counts: Cumulative number of messages by channel id, for channels whose count changed. Routes of publishers
            refer to this dictionary.
        made: New connections to the participant: channel id, topic, publisher, subscriber's TCP port.
        lost: Ids of closed connections to the participant.
        counted: Numbers of the participant's own connections whose subscriber has become a participant.
        uncounted: Numbers of those whose subscriber is no longer a participant.
        made_by: Number of new connections by publisher.
        reset: Whether simulation time was reset.
        void: Channel ids with the number of messages sent before the reset.
    """

    def __init__(self) -> None:
        self.counts: dict[int, int] = {}
        self.made: list[list[Any]] = []
        self.lost: list[int] = []
        self.counted: list[int] = []
        self.uncounted: list[int] = []
        self.made_by: dict[str, int] = {}
        self.reset = False
        self.void: list[list[int]] = []

    def has_peers(self) -> bool:
        """Return whether there is anything but counts."""
        return bool(self.made or self.lost or self.counted or self.uncounted or self.reset)

    def mark_void(self) -> None:
        """Mark all counted messages that have not been reported yet as sent before a reset."""
        self.void = [[channel, count] for channel, count in self.counts.items()]

    def take_peers(self) -> list[dict[str, Any]]:
        """Return the contents of the PEER frames to send and clear them here.

        Connections made come before connections lost; each frame has at most ``MOST_NEWS_PER_FRAME`` entries of a kind.
        """
        first: dict[str, list[Any]] = {"made": self.made, "counted": self.counted}
        then: dict[str, list[Any]] = {"lost": self.lost, "uncounted": self.uncounted}
        if self.reset:
            then["void"] = self.void
        elif not self.has_peers():
            return []
        if all(len(entries) <= MOST_NEWS_PER_FRAME for entries in (*first.values(), *then.values())):
            contents: list[dict[str, Any]] = [{**first, **then}]
        else:
            contents = [*_pieces(first), *_pieces(then)]
        if self.reset:
            contents[-1]["reset"] = True
        self.made, self.lost, self.counted, self.uncounted, self.void = [], [], [], [], []
        self.reset = False
        self.made_by.clear()
        return [{"made": [], "lost": [], "counted": [], "uncounted": [], **content} for content in contents]


def _pieces(lists: Mapping[str, list[Any]]) -> Iterator[dict[str, Any]]:
    for at in range(0, max(map(len, lists.values())), MOST_NEWS_PER_FRAME):
        yield {name: entries[at : at + MOST_NEWS_PER_FRAME] for name, entries in lists.items()}


class Participant:
    """The server's record of one participant, or of the simulator as one end of topic connections.

    Attributes:
        name: Resolved ROS name, such as /follower_1.
        connection: Its connection; None for the simulator itself.
        rate: Turns per second of simulation time in Hz; 0 for the simulator.
        schedule: Times of its turns; None for the simulator.
        due_us: Simulation time of its next turn in microseconds.
        waiting: Whether the barrier is waiting for its DONE.
        needs_time: Whether it is waiting for an event that needs simulation time to advance.
        tick: Number of its last TICK, 0 before the first.
        asked: Monotonic wall time of its last TICK in seconds.
        outgoing: Its topic connections as publisher.
        news: Changes to be sent with its next TICK.
        udp_ports: Local UDP ports on which it receives the simulator's datagrams.
        datagrams_base: Datagrams that the simulator had sent to each of these ports before it joined.
        datagrams_reported: Datagrams to each of these ports reported to it since.
        datagrams_sent: Datagrams that it has sent, by the simulator's port.
    """

    def __init__(self, name: str, connection: ClientConnection | None, rate: float, schedule: Schedule | None) -> None:
        self.name = name
        self.connection = connection
        self.rate = rate
        self.schedule = schedule
        self.due_us = 0
        self.waiting = False
        self.needs_time = False
        self.tick = 0
        self.asked = 0.0 if connection is None else connection.accepted
        self.outgoing = Outgoing()
        self.news = News()
        self.udp_ports: tuple[int, ...] = ()
        self.datagrams_base: dict[int, int] = {}
        self.datagrams_reported: dict[int, int] = {}
        self.datagrams_sent: dict[int, int] = {}

    @property
    def address(self) -> str:
        """Host and port of its connection."""
        return "the simulator" if self.connection is None else self.connection.address

    @property
    def remote(self) -> bool:
        """Whether it runs on another machine."""
        return self.connection is not None and self.connection.remote

    @property
    def heard(self) -> float:
        """Monotonic wall time in seconds at which data was last received from it."""
        return self.asked if self.connection is None else self.connection.heard
