"""Topic connections (channels) between participants, and the routing of message counts from publisher to subscriber."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection, Iterator, Mapping
from typing import Any, Protocol

from ..protocol import ProtocolError
from .client_sockets import Log
from .frame_checks import MOST_CHANNELS, Declaration, Made, Peers
from .missing_connections import MissingConnections, TopicTable
from .participant import Channel, Outgoing, Pair, Participant


class HostLink(Protocol):
    """The simulator's own publishers and subscribers, see ``client.Host``."""

    name: str

    def collect(self) -> tuple[dict[str, Any] | None, list[list[Any]], list[int], dict[int, int]]:
        """Return the changes: declaration (as DECLARE) or None, peers made, numbers of peers lost, channel counts."""

    def counted(self, number: int, value: bool) -> None:
        """Set whether the subscriber of a connection is a participant."""

    def connect_again(self, topics: Collection[str]) -> None:
        """Ask the master again for participants to which a subscribed topic has no connection."""

    def deliver(self, news: Mapping[str, Any], counts: Mapping[int, int]) -> None:
        """Accept, after a barrier, the numbers of messages sent to the simulator.

        Args:
            news: Connections to its subscribers, as in a PEER frame: made, lost, void.
            counts: Cumulative number of messages by channel, where it changed.
        """


class Channels:
    """All channels, and the connections that the declared topics still require.

    Attributes:
        missing: Required connections that are not made yet.
    """

    def __init__(self, participants: Mapping[str, Participant], connect_limit: float, log: Log) -> None:
        """Start without channels.

        Args:
            participants: Those that have joined, by name; kept up to date by the server.
            connect_limit: Wall seconds that the simulation waits for a connection.
            log: Receives log messages.
        """
        self.missing = MissingConnections()
        self._participants = participants
        self._connect_limit = connect_limit
        self._log = log
        self._topics = TopicTable()
        self._next_id = 1
        self._live: dict[Pair, set[int]] = {}  # ids of the counted channels by pair
        # By subscriber and channel id: the publisher and its own number.
        self._towards: dict[str, dict[int, tuple[Participant, int]]] = {}
        self._ignored_counts: dict[int, int] = {}
        self._host: HostLink | None = None
        self._host_end: Participant | None = None

    # ---- the simulator's own topics ----

    def attach_host(self, link: HostLink) -> None:
        """Count the messages between the simulator itself and participants.

        Raises:
            ValueError: One is attached already.
        """
        if self._host is not None:
            raise ValueError("the simulator's own publishers are attached already")
        self._host = link
        self._host_end = Participant(link.name, None, 0.0, None)

    def host_named(self, name: str) -> Participant | None:
        """Return the simulator's end if ``name`` is the simulator's, else None."""
        return self._host_end if self._is_host(name) else None

    def collect_host(self) -> None:
        """Apply the changes of the simulator's own topics."""
        if self._host is None or self._host_end is None:
            return
        declaration, made, lost, counts = self._host.collect()
        if declaration is not None:
            topics = (dict(declaration.get(key, ())) for key in ("publications", "subscriptions"))
            self.declare(self._host_end, Declaration(*topics))
        if made or lost:
            self.update(self._host_end, Peers([Made(*row) for row in made], lost))
        for number, count in counts.items():
            route = self._host_end.outgoing.routes.get(number)
            if route is not None:
                route[0][route[1]] = count
        self._host_end.outgoing.forget_closed()

    def deliver_to_host(self) -> None:
        """Report to the simulator's own subscribers the numbers of messages sent to them by the end of a tick."""
        if self._host is None or self._host_end is None:
            return
        news = self._host_end.news
        if not (news.made or news.lost or news.counts):
            return
        peers = {"made": news.made, "lost": news.lost, "void": news.void}
        counts = dict(news.counts)
        news.counts.clear()
        news.made, news.lost, news.void = [], [], []
        news.made_by.clear()
        self._host.deliver(peers, counts)

    def reset(self) -> None:
        """Mark messages in transit to the simulator as sent before a reset of simulation time."""
        if self._host_end is not None:
            self._host_end.news.mark_void()

    def _is_host(self, name: str) -> bool:
        return self._host_end is not None and self._host_end.name == name

    # ---- declarations ----

    def declare(self, participant: Participant, declaration: Declaration) -> None:
        """Replace a participant's topics and determine the connections that they require.

        Raises:
            ProtocolError: They require more than ``MOST_CHANNELS`` connections.
        """
        self._topics.declare(participant.name, declaration)
        required = self._required_pairs(participant)
        for pair in self.missing.of(participant.name):
            if pair not in required:
                self.missing.discard(pair)
        now = time.monotonic()
        for pair in sorted(required):
            if pair not in self._live:
                self.missing.add(pair, now, self._connect_limit)

    def _required_pairs(self, participant: Participant) -> set[Pair]:
        pairs = set()
        for pair, sent, read in self._topics.pairs(participant.name):
            topic, publisher, subscriber = pair
            if publisher == subscriber and self._is_host(publisher):
                continue
            if sent == read or "*" in {sent, read}:
                pairs.add(pair)
                if len(pairs) > MOST_CHANNELS:
                    raise ProtocolError(f"its topics need more than {MOST_CHANNELS} connections")
            elif self._topics.is_new_clash(pair):
                text = f"{topic}: {publisher} publishes {sent}, {subscriber} subscribes to {read}"
                self._log(logging.WARNING, text)
        return pairs

    def ask_again(self) -> Iterator[tuple[Participant, list[str]]]:
        """Yield the participants that are to ask the master again, with the topics that lack connections.

        The simulator's own end asks itself.
        """
        if not self.missing:
            return
        topics: dict[str, dict[str, None]] = {}
        pairs = self.missing.take_due(time.monotonic())
        for topic, _, subscriber in pairs:
            topics.setdefault(subscriber, {})[topic] = None
        if pairs:
            topic, publisher, subscriber = pairs[0]
            others = f" and {len(pairs) - 1} other connections" if len(pairs) > 1 else ""
            text = f"{topic} from {publisher} to {subscriber}{others}"
            self._log(logging.INFO, f"asking the master again for connections that are not made: {text}")
        for name, asked in topics.items():
            participant = self._participants.get(name)
            if participant is not None:
                yield participant, list(asked)
            elif self._host is not None and self._is_host(name):
                self._host.connect_again(list(asked))

    def give_up_missing(self) -> None:
        """Stop waiting for connections that have not been made in time, with a warning for each."""
        if not self.missing:
            return
        for (topic, publisher, subscriber), asked in self.missing.expire(time.monotonic()):
            times = f"{asked} time{'s' * (asked != 1)}"
            self._log(
                logging.WARNING,
                f"no connection of {topic} from {publisher} to {subscriber} within {self._connect_limit:g} s, "
                f"though the master was asked again {times}: continuing without it",
            )

    # ---- counts ----

    def count(self, publisher: Participant, counts: Mapping[int, int]) -> None:
        """Route the counts of a DONE to the subscribers.

        Args:
            publisher: The participant that has sent the messages.
            counts: Cumulative number of messages by the publisher's own number.
        """
        routes = publisher.outgoing.routes
        for number, count in counts.items():
            target, channel = routes.get(number, (self._ignored_counts, 0))  # it may have been closed since
            target[channel] = count
        publisher.outgoing.forget_closed()

    # ---- channels ----

    def update(self, publisher: Participant, peers: Peers) -> None:
        """Apply a publisher's report of connections made and lost.

        Raises:
            ProtocolError: A connection is made twice, or there are too many.
        """
        for made in peers.made:
            self._make_channel(publisher, made)
        for number in peers.lost:  # after those made: one report may have both ends of a short connection
            self._close_channel(publisher, number)

    def add_participant(self, reader: Participant) -> None:
        """Open the channels to a participant that were made before it joined."""
        towards = self._towards.get(reader.name)
        if not towards:
            return
        host = [] if self._host_end is None else [self._host_end]
        order = {publisher: index for index, publisher in enumerate([*host, *self._participants.values()])}
        for publisher, number in sorted(towards.values(), key=lambda entry: order[entry[0]]):
            counts, channel = publisher.outgoing.routes[number]
            if counts is not self._ignored_counts:
                self._open_channel(publisher, number, reader, counts.get(channel, 0))

    def remove_participant(self, participant: Participant) -> None:
        """Close the channels of a participant that is no longer among the participants."""
        name = participant.name
        for number in list(participant.outgoing.channels):
            self._close_channel(participant, number)
        self._topics.remove(name)
        for channel, (publisher, number) in self._towards.get(name, {}).items():
            # A later participant of this name makes connections of its own.
            publisher.outgoing.routes[number] = (self._ignored_counts, 0)
            self._set_counted(publisher, number, False)
            self._remove_live(publisher.outgoing.channels[number].pair, channel)
        for pair in self.missing.of(name):
            self.missing.discard(pair)

    def _make_channel(self, publisher: Participant, made: Made) -> None:
        outgoing = publisher.outgoing
        if made.number in outgoing.routes:
            raise ProtocolError(f"PEER: connection {made.number} is made twice")
        if len(outgoing.routes) >= MOST_CHANNELS and not self._is_host(publisher.name):
            raise ProtocolError(f"PEER: more than {MOST_CHANNELS} connections")
        channel = Channel(self._next_id, (made.topic, publisher.name, made.subscriber), made.port)
        self._next_id += 1
        outgoing.channels[made.number] = channel
        self._towards.setdefault(made.subscriber, {})[channel.id] = publisher, made.number
        reader = self._reader(channel)
        if reader is None:
            # The subscriber is not a participant, or not yet: keep the count until it joins.
            outgoing.routes[made.number] = ({channel.id: made.sent}, channel.id)
        else:
            self._open_channel(publisher, made.number, reader, made.sent)

    def _reader(self, channel: Channel) -> Participant | None:
        """Return the counting end of a channel: a participant, or the simulator for topics that it declares."""
        topic, publisher, subscriber = channel.pair
        if not self._is_host(subscriber):
            return self._participants.get(subscriber)
        return self._host_end if self._topics.subscribes(subscriber, topic) and publisher != subscriber else None

    def _open_channel(self, publisher: Participant, number: int, reader: Participant, count: int) -> None:
        """Start routing the counts of a channel to its reader."""
        channel = publisher.outgoing.channels[number]
        news = reader.news
        publisher.outgoing.routes[number] = (news.counts, channel.id)
        self._set_counted(publisher, number, True)
        if count:
            news.counts[channel.id] = count
        news.made.append([channel.id, channel.pair[0], publisher.name, channel.port])
        self._live.setdefault(channel.pair, set()).add(channel.id)
        self.missing.discard(channel.pair)
        made = news.made_by[publisher.name] = news.made_by.get(publisher.name, 0) + 1
        if made > MOST_CHANNELS and not self._is_host(publisher.name):
            raise ProtocolError(f"PEER: more than {MOST_CHANNELS} connections to {reader.name} within its turn")

    def _set_counted(self, publisher: Participant, number: int, value: bool) -> None:
        """Report to a publisher whether a connection's subscriber is a participant."""
        if self._host is not None and publisher is self._host_end:
            self._host.counted(number, value)
        else:
            (publisher.news.counted if value else publisher.news.uncounted).append(number)

    def _close_channel(self, publisher: Participant, number: int) -> None:
        outgoing: Outgoing = publisher.outgoing
        channel = outgoing.channels.pop(number, None)
        if channel is None:
            return
        # A count still on its way finds this route and is ignored.
        outgoing.routes[number] = (self._ignored_counts, 0)
        outgoing.closing.append(number)
        topic, name, subscriber = channel.pair
        del self._towards[subscriber][channel.id]
        if not self._towards[subscriber]:
            del self._towards[subscriber]
        if not self._remove_live(channel.pair, channel.id):
            return
        reader = self._reader(channel)
        if reader is None:
            return
        reader.news.lost.append(channel.id)
        is_there = name in self._participants or self._is_host(name)
        required = is_there and self._topics.publishes(name, topic) and self._topics.subscribes(reader.name, topic)
        if required and channel.pair not in self._live:
            self.missing.add(channel.pair, time.monotonic(), self._connect_limit)

    def _remove_live(self, pair: Pair, channel: int) -> bool:
        """Remove a counted channel; return whether it was one."""
        live = self._live.get(pair, set())
        if channel not in live:
            return False
        live.discard(channel)
        if not live:
            del self._live[pair]
        return True
