"""The rule of the lockstep under random scheduling: a message of tick k is dispatched in the receiver's next turn.

It is never dispatched earlier or later, whichever participants die, join or are slow. The test runs the real server on
real sockets and plays the participants, one small action at a time. It chooses at random which of them acts next, how
its bytes are split, and when connections are made and messages arrive. Everything runs in one thread, so that a seed
reproduces its run.
"""

from __future__ import annotations

import random
import select
import socket
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

import pytest

from xtdrone_lockstep.protocol import (
    VERSION,
    FrameReader,
    Kind,
    pack_barrier,
    pack_object,
    unpack_barrier,
    unpack_object,
)
from xtdrone_lockstep.server import LockstepServer

RATES = (20.0, 30.0, 50.0, 125.0, 250.0)
MOST_ACTIONS = 20_000  # in one barrier; more are considered a deadlock

Message = tuple[str, int, int]
"""Publisher, the tick in which it was published, running number."""


@dataclass
class Connection:
    """One topic connection: ``wire`` holds messages on their way, ``inbox`` those that have arrived."""

    publisher: Member
    subscriber: Member
    number: int
    port: int
    sent: int = 0
    announced: bool = False
    reported: bool = False  # reported as lost
    wire: deque[Message] = field(default_factory=deque)
    inbox: deque[Message] = field(default_factory=deque)
    arrived: int = 0
    dispatched: list[tuple[int, Message]] = field(default_factory=list)  # with the tick of the dispatch
    target: int | None = None


class Member:
    """A participant that publishes on a topic of its own name and subscribes to some of the others'."""

    def __init__(self, world: World, name: str, rate: float, subscribes: list[str]) -> None:
        self.world = world
        self.name = name
        self.rate = rate
        self.subscribes = subscribes
        self.sock: socket.socket | None = None
        self.joined = False
        self.dead = False
        self.out = bytearray()
        self.reader = FrameReader()
        self.frames: deque[tuple[int, bytes]] = deque()
        self.channels: dict[int, Connection] = {}
        self.tick = 0
        self.ended = 0  # the tick whose DONE was written last
        self.now = 0
        self.outlets: list[Connection] = []
        self.changed: dict[int, int] = {}
        self.published: list[Message] = []
        self.finished: set[int] = set()  # ticks whose DONE has been sent completely
        self.turns: list[int] = []
        self.script: Iterator[None] | None = None

    # its actions

    def start(self) -> None:
        host, port = self.world.server.uri.removeprefix("tcp://").split(":")
        self.sock = socket.create_connection((host, int(port)))
        self.sock.setblocking(False)
        content = {
            "version": VERSION,
            "name": self.name,
            "rate": self.rate,
            "pid": 0,
            "host": "",
            "publications": [[self.name, "t"]],
            "subscriptions": [[topic, "t"] for topic in self.subscribes],
        }
        self.send(pack_object(Kind.JOIN, content))
        self.joined = True

    def send(self, data: bytes) -> None:
        self.out += data

    def die(self) -> None:
        self.dead = True
        if self.sock is not None:
            self.sock.close()

    def actions(self) -> list:
        """Return the possible actions."""
        if self.dead or self.sock is None:
            return []
        found = [self.receive] if select.select([self.sock], [], [], 0.0)[0] else []
        if self.out:
            found.append(self.flush)
        if self.script is not None or self.frames:
            found.append(self.go_on)
        return found

    def flush(self) -> None:
        assert self.sock is not None
        size = self.world.random.randint(1, len(self.out))
        try:
            self.sock.send(bytes(self.out[:size]))
        except OSError:  # dropped by the server
            self.dead = True
            return
        del self.out[:size]
        if not self.out and self.ended:
            self.finished.add(self.ended)

    def receive(self) -> None:
        assert self.sock is not None
        try:
            data = self.sock.recv(self.world.random.choice([1, 7, 65536]))
        except OSError:
            self.dead = True
            return
        if not data:
            self.dead = True
            return
        self.reader.feed(data)
        self.frames.extend(self.reader.frames())

    def go_on(self) -> None:
        if self.script is None:
            kind, payload = self.frames.popleft()
            if kind == Kind.PEER:
                self.peers(unpack_object(payload))
            elif kind == Kind.TICK:
                self.script = self.turn(unpack_barrier(payload))
            return
        if next(self.script, "end") == "end":
            self.script = None

    def peers(self, content: dict) -> None:
        for channel, topic, publisher, port in content["made"]:
            assert topic == publisher
            (connection,) = (c for c in self.world.connections if c.port == port and c.subscriber is self)
            assert connection.publisher.name == publisher
            self.channels[channel] = connection

    def turn(self, tick) -> Iterator[None]:
        self.tick, self.now = tick.tick, tick.time_us
        self.turns.append(self.tick)
        for channel, count in tick.channels.items():
            self.channels[channel].target = count
        for connection in list(self.channels.values()):
            while connection.target is not None and connection.arrived < connection.target:
                assert not connection.publisher.dead or connection.wire, "waits for what was never sent"
                yield
            while connection.target is not None and len(connection.dispatched) < connection.target:
                connection.dispatched.append((self.tick, connection.inbox.popleft()))
        for _ in range(self.world.random.choice([0, 1, 3])):
            self.publish()
            yield
        self.send(pack_barrier(Kind.DONE, self.tick, self.now, self.changed, {}))
        self.changed = {}
        self.ended = self.tick

    def publish(self) -> None:
        message = (self.name, self.tick, len(self.published))
        self.published.append(message)
        for connection in self.outlets:
            if connection.reported:
                continue
            connection.wire.append(message)
            connection.sent += 1
            if connection.announced:
                self.changed[connection.number] = connection.sent


class Host(Member):
    """The simulator as a subscriber: after each barrier it dispatches the messages sent in that tick."""

    def __init__(self, world: World, name: str, subscribes: list[str]) -> None:
        super().__init__(world, name, 0.0, subscribes)
        self.declaration: dict | None = {"publications": [], "subscriptions": [[topic, "t"] for topic in subscribes]}
        self.counts: dict[int, int] = {}

    # called by the server

    def collect(self) -> tuple:
        declaration, self.declaration = self.declaration, None
        return declaration, [], [], {}

    def counted(self, number: int, value: bool) -> None:
        raise AssertionError("it publishes nothing")

    def connect_again(self, topics: Collection[str]) -> None:
        pass  # connections on their way arrive

    def deliver(self, news: dict, counts: dict[int, int]) -> None:
        self.peers(news)
        self.counts.update(counts)

    # called by the simulator

    def hear(self, tick: int) -> None:
        self.tick = tick
        self.turns.append(tick)
        counts, self.counts = self.counts, {}
        for channel, count in counts.items():
            connection = self.channels[channel]
            connection.target = count
            while connection.arrived < count:
                assert connection.wire, "waits for what was never sent"
                self.world.idle(0.0)
            while len(connection.dispatched) < count:
                connection.dispatched.append((tick, connection.inbox.popleft()))


class World:
    """The server, the members and an adversarial scheduler."""

    def __init__(self, seed: int, count: int, deaths: int, late: int) -> None:
        self.random = random.Random(seed)
        self.warnings: list[str] = []
        self.server = LockstepServer(hang_limit=0.0, connect_limit=90.0, log=lambda _, text: self.warnings.append(text))
        names = [f"/m{i}" for i in range(count)]
        self.members = [
            Member(
                self, name, self.random.choice(RATES), [n for n in names if n != name and self.random.random() < 0.6]
            )
            for name in names
        ]
        self.host = Host(self, "/host", [name for name in names if self.random.random() < 0.6])
        self.server.attach_host(self.host)
        self.waiting = self.members[len(self.members) - late :] if late else []
        self.deaths = deaths
        self.connections: list[Connection] = []
        self.busy = 0
        self.haste = self.random.choice([0.0, 0.003, 0.05])  # 0: connections are made only when nothing else can happen
        self.flying = False  # until then no member dies or joins late, since the start waits for all of them by name
        for member in self.members:
            if member not in self.waiting:
                member.start()

    def possible_connections(self) -> list[tuple[Member, Member]]:
        made = {(c.publisher.name, c.subscriber.name) for c in self.connections}
        return [
            (publisher, subscriber)
            for publisher in self.members
            for subscriber in (*self.members, self.host)
            if publisher.name in subscriber.subscribes
            and publisher.joined  # ROS also connects a subscriber that has not joined yet
            and not publisher.dead
            and not subscriber.dead
            and (publisher.name, subscriber.name) not in made
        ]

    def connect(self, publisher: Member, subscriber: Member) -> None:
        connection = Connection(publisher, subscriber, len(publisher.outlets) + 1, 40000 + len(self.connections))
        self.connections.append(connection)
        publisher.outlets.append(connection)

    @staticmethod
    def announce(connection: Connection) -> None:
        connection.announced = True
        publisher, subscriber = connection.publisher, connection.subscriber
        made = [[connection.number, publisher.name, subscriber.name, connection.port, connection.sent]]
        publisher.send(pack_object(Kind.PEER, {"made": made, "lost": []}))

    def lose(self, connection: Connection) -> None:
        connection.reported = True
        connection.publisher.send(pack_object(Kind.PEER, {"made": [], "lost": [connection.number]}))
        connection.publisher.changed.pop(connection.number, None)

    def act(self) -> None:
        """Perform one action."""
        choices: list = []
        slow: list = []  # making connections, which takes long compared with messages
        for member in self.members:
            choices += member.actions()
        for publisher, subscriber in self.possible_connections():
            slow.append(lambda p=publisher, s=subscriber: self.connect(p, s))
        for connection in self.connections:
            if not connection.announced and not connection.publisher.dead:
                slow.append(lambda c=connection: self.announce(c))
            if connection.wire and not connection.subscriber.dead:
                choices.append(lambda c=connection: self.deliver(c))
            if (
                connection.announced
                and connection.subscriber.dead
                and not connection.reported
                and not connection.publisher.dead
            ):
                choices.append(lambda c=connection: self.lose(c))
        alive = [m for m in self.members if m.joined and not m.dead]
        if not self.flying:
            pass
        elif self.waiting and self.random.random() < 0.02:
            choices = [self.waiting.pop().start]
        elif self.deaths and len(alive) > 2 and self.random.random() < 0.01:
            self.deaths -= 1
            choices = [self.random.choice(alive).die]
        if slow and (not choices or self.random.random() < self.haste):
            choices = slow
        if choices:
            self.random.choice(choices)()

    @staticmethod
    def deliver(connection: Connection) -> None:
        connection.inbox.append(connection.wire.popleft())
        connection.arrived += 1

    def idle(self, _: float) -> None:
        """Perform actions while the barrier waits."""
        self.busy += 1
        assert self.busy < MOST_ACTIONS, f"deadlock; warnings: {self.warnings[-3:]}"
        self.act()

    def run(self, ticks: int) -> None:
        first = [m.name for m in self.members if m.joined]
        assert self.server.wait_for(first, None, self.idle)
        self.flying = True
        now: int | None = 0
        for _ in range(ticks):
            if now is None:
                break
            self.busy = 0
            self.server.tick(now, idle=self.idle)
            self.host.hear(max(member.tick for member in self.members))
            now = self.server.next_due_us(now)
        self.server.close()
        for member in self.members:
            if member.sock is not None:
                member.sock.close()


def law(connection: Connection) -> None:
    """Compare the messages dispatched from a connection with those published over it."""
    reader, writer = connection.subscriber, connection.publisher
    got = [message for _, message in connection.dispatched]
    first = got[0][2] if got else len(writer.published)
    assert got == writer.published[first : first + len(got)], "in order, none lost, none twice"
    for tick, message in connection.dispatched:
        previous = max((turn for turn in reader.turns if turn < tick), default=0)  # its first turn takes all before
        if isinstance(reader, Host):  # its turn is at the end of a tick, after all others
            assert previous < message[1] <= tick, f"{message} was heard in tick {tick}, the turn before was {previous}"
            continue
        assert previous <= message[1] < tick, f"{message} was dispatched in tick {tick}, the turn before was {previous}"
    if reader.dead or not reader.turns or (writer.dead and writer.turns[-1:] < reader.turns[:1]):
        return  # the publisher died before the reader joined: it was no participant in its time
    # All messages published over this connection, or since both took part, in turns that ended before its last one.
    last, since = reader.turns[-1], len(writer.published) - connection.sent
    due = [
        message
        for message in writer.published
        if (message[2] >= since or message[1] >= reader.turns[0])
        and message[1] < last + isinstance(reader, Host)
        and message[1] in writer.finished
    ]
    assert reader.script is not None or got[: len(due)] == due, (
        f"{len(due) - len(got)} messages are late in tick {last}"
    )


@pytest.mark.parametrize("seed", range(45))
def test_message_is_dispatched_in_the_first_turn_after_its_tick(seed: int):
    sizes = random.Random(-1 - seed)
    deaths = sizes.randint(0, 3)
    world = World(seed, count=sizes.randint(3, 6), deaths=deaths, late=sizes.randint(1, 2))
    world.run(ticks=15)
    for publisher, subscriber in world.possible_connections():
        world.connections.append(Connection(publisher, subscriber, 0, 0))  # never connected: the rule still holds
    for connection in world.connections:
        law(connection)
    assert all(member.turns for member in world.members if not member.dead and member not in world.waiting) or deaths
    assert deaths or any(connection.dispatched for connection in world.connections), "nothing was checked"
