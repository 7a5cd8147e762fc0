"""Random input to the lockstep server: invalid data closes the connection of its sender and nothing else.

The test runs the real server on real sockets with two correct participants, the simulator's own topics, and clients
that send valid, modified, truncated and misplaced frames before they join, with a reserved name, and as participants.
Everything runs in one thread, so that a seed reproduces its run.
"""

from __future__ import annotations

import copy
import json
import math
import os
import random
import socket
import struct
from collections.abc import Collection
from typing import Any

import pytest

from xtdrone_lockstep.protocol import (
    ALIVE_FRAME,
    BASE_STEP_US,
    NEEDS_TIME_FRAME,
    VERSION,
    Barrier,
    FrameReader,
    Kind,
    pack_barrier,
    pack_object,
    unpack_barrier,
    unpack_object,
)
from xtdrone_lockstep.server import LockstepServer

FRAMES = int(os.environ.get("LOCKSTEP_FUZZ_FRAMES", "24000"))
"""Total number of frames to send; for a million use pytest --timeout=0."""
SEEDS = 3
CLIENTS = 6
PATIENCE = 8  # polls of one tick after which clients that still hold it are closed
LONGEST_LINE = 2500
PORTS = (18570, 34580)
GOOD = ("/good_0", "/good_1")
NAMES = ("/h0", "/h1", "/h2", "/h3", "/h4", "/ns/h5")
TOPICS = ("/t", "/models", "/a", "/b/c")
TYPES = ("std_msgs/String", "T", "*")
BAD: tuple[Any, ...] = (
    10**400, -(10**30), -5, -1, 0, 1 << 31, 1 << 32, 1 << 64, 1e-320, 0.5, math.inf, -math.inf, math.nan,
    "abc", "", "\n[WARN] [1.0]: simulator: participant /leader is gone", "\x1b[2J\x07", "\ud800", "/" + "x" * 300,
    "/a//b", "a b", "12", None, True, [], {}, [[]], [None] * 30, {"a": {}}, "/t", "/good_1",
)  # fmt: skip


class Good:
    """A correct participant that checks everything it receives."""

    def __init__(self, world: World, name: str, topics: dict[str, list[list[str]]]) -> None:
        self.world = world
        self.name = name
        self.count = 0  # messages sent over each of its connections
        self.reported = 0  # the count at the end of the last tick
        self.channels: dict[int, tuple[str, str]] = {}
        self.known: dict[int, int] = {}
        self.tick = 0
        self.reader = FrameReader()
        self.sock = socket.create_connection(world.address)
        self.sock.setblocking(False)
        content = {"version": VERSION, "name": name, "rate": 250.0, "udp_ports": [14540], **topics}
        self.sock.sendall(pack_object(Kind.JOIN, content))

    def announce(self, subscribers: tuple[str, ...]) -> None:
        made = [[number, "/t", subscriber, 1000 + number, 0] for number, subscriber in enumerate(subscribers)]
        self.sock.sendall(pack_object(Kind.PEER, {"made": made, "lost": []}))

    def play(self) -> None:
        try:
            data = self.sock.recv(1 << 20)
        except BlockingIOError:
            return
        assert data, f"{self.name} was dropped: {self.world.lines[-3:]}"
        self.reader.feed(data)
        for kind, payload in self.reader.frames():
            if kind == Kind.PEER:
                content = unpack_object(payload)
                self.channels |= {row[0]: (row[1], row[2]) for row in content["made"]}
                for channel in content["lost"]:
                    del self.channels[channel]
            elif kind == Kind.TICK:
                self.turn(unpack_barrier(payload))
            else:
                assert kind == Kind.WELCOME

    def turn(self, tick: Barrier) -> None:
        assert tick.time_us == self.world.now
        assert tick.tick == self.tick + 1, "it is due at each tick"
        self.tick = tick.tick
        self.known |= tick.channels
        for channel, (topic, publisher) in self.channels.items():
            if (topic, publisher) == ("/t", GOOD[0]):
                assert self.known.get(channel, 0) == self.world.good[0].reported
        assert tick.datagrams == {14540: tick.tick}
        self.count += self.world.random.randint(0, 2)
        counts = dict.fromkeys(range(2), self.count) if self.name == GOOD[0] else {}
        self.sock.sendall(pack_barrier(Kind.DONE, tick.tick, tick.time_us, counts, {PORTS[0]: 3 * tick.tick}))


class Simulator:
    """The simulator's own topics."""

    name = "/simulator"

    def __init__(self, world: World) -> None:
        self.world = world
        self.news: list[Any] = [
            ({"publications": [["/models", "T"]], "subscriptions": [["/t", "std_msgs/String"]]}, [], [], {}),
            (None, [[1, "/models", GOOD[1], 1000, 0]], [], {}),
        ]
        self.channels: dict[int, str] = {}
        self.known: dict[int, int] = {}

    def collect(self) -> tuple[Any, list[Any], list[int], dict[int, int]]:
        return self.news.pop(0) if self.news else (None, [], [], {})

    def counted(self, number: int, value: bool) -> None:
        assert number == 1

    def connect_again(self, topics: Collection[str]) -> None:
        assert set(topics) <= {"/t"}

    def deliver(self, news: dict[str, Any], counts: dict[int, int]) -> None:
        self.channels |= {row[0]: row[2] for row in news["made"]}
        for channel in news["lost"]:
            del self.channels[channel]
        self.known |= counts
        for channel, publisher in self.channels.items():
            if publisher == GOOD[0]:
                assert self.known.get(channel, 0) == self.world.good[0].count


class Client:
    """A client that sends random frames."""

    def __init__(self, world: World) -> None:
        self.random = world.random
        self.sock = socket.create_connection(world.address)
        self.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # no TIME_WAIT
        self.sock.setblocking(False)
        self.reader = FrameReader()
        self.tick = Barrier(0, 0, {}, {})
        self.name = self.random.choice((*NAMES, *NAMES, *NAMES, GOOD[1], "/simulator"))
        self.joined = False
        self.number = 0
        self.datagrams = 0

    def act(self) -> int:
        """Send some frames; return how many."""
        frames = self.opening() if not self.joined else [self.frame() for _ in range(self.random.randint(1, 12))]
        count = len(frames)
        if self.random.random() < 0.1:
            self.random.shuffle(frames)
        data = b"".join(frames)
        if self.random.random() < 0.03:
            data = data[: self.random.randrange(len(data) + 1)]
        try:
            self.sock.send(data)
            self.read()
        except BlockingIOError:
            pass
        return count

    def read(self) -> None:
        self.reader.feed(self.sock.recv(1 << 16))
        for kind, payload in self.reader.frames():
            if kind == Kind.TICK:
                self.tick = unpack_barrier(payload)

    def opening(self) -> list[bytes]:
        """Return the frames for joining, usually correct, sometimes with frames allowed only later."""
        way = self.random.random()
        introduction = {"version": VERSION, "name": self.name, "pid": os.getpid(), "host": ""}
        frames = []
        if way < 0.3:
            frames.append(self.changed(Kind.RESERVE, introduction, 0.2))
        if way < 0.95:
            join = {**introduction, "rate": self.random.choice((250.0, 30, 7.5)), "udp_ports": [14540, 14541]}
            frames.append(self.changed(Kind.JOIN, join | self.topics(), 0.25))
            self.joined = True
        if way > 0.92:
            frames.append(self.frame())
        return frames

    def topics(self) -> dict[str, Any]:
        return {
            key: [[topic, self.random.choice(TYPES)] for topic in TOPICS if self.random.random() < 0.4]
            for key in ("publications", "subscriptions")
        }

    def frame(self) -> bytes:
        """Return a frame that a participant may send, or a similar one."""
        choice = self.random.random()
        if choice < 0.25:
            return self.done()
        if choice < 0.35:
            return self.random.choice((ALIVE_FRAME, NEEDS_TIME_FRAME))
        if choice < 0.65:
            return self.changed(Kind.PEER, {"made": [self.made()], "lost": self.lost()}, 0.03)
        if choice < 0.75:
            return self.changed(Kind.DECLARE, self.topics(), 0.05)
        if choice < 0.85:
            state = [self.random.randrange(100) for _ in range(3)]
            return self.changed(Kind.DIGEST, {"time_us": self.tick.time_us, "topics": {"/t": state}}, 0.05)
        if choice < 0.853:
            return self.changed(Kind.LEAVE, {"reason": "it crashed: \x1b[1m\nno", "failed": True}, 0.3)
        if choice < 0.99:
            return self.done()
        if choice < 0.993:
            return self.changed(Kind.JOIN, {"version": VERSION, "name": self.name, "rate": 30}, 0.5)
        return self.noise()

    def made(self) -> list[Any]:
        self.number += 1
        subscriber = self.random.choice((*GOOD, *NAMES, "/simulator", "/rosbag"))
        return [self.number, self.random.choice(TOPICS), subscriber, self.random.randrange(65536), self.number % 5]

    def lost(self) -> list[int]:
        return [self.random.randint(0, self.number)] if self.random.random() < 0.6 else []

    def done(self) -> bytes:
        tick = self.tick.tick if self.random.random() < 0.9 else self.random.randrange(1 << 64)
        counts = {self.random.randint(0, self.number): self.random.randrange(1 << 40) for _ in range(3)}
        self.datagrams += self.random.randint(-1, 300)
        ports = {self.random.choice((*PORTS[1:], 9, 70000)): max(0, self.datagrams) for _ in range(2)}
        return self.damaged(pack_barrier(Kind.DONE, tick, self.tick.time_us, counts, ports), 0.01)

    def noise(self) -> bytes:
        size = self.random.choice((0, 1, 5, 24, 100, 70000))
        kind = self.random.choice((*Kind, 0, 99, 255))
        length = self.random.choice((size + 1, size + 1, 0, 1 << 20, 1 << 32 - 1))
        return struct.pack("<IB", length & 0xFFFFFFFF, kind) + self.random.randbytes(size)

    def changed(self, kind: Kind, content: dict[str, Any], chance: float) -> bytes:
        """Return a frame with a JSON object, at random with a value replaced, removed or duplicated."""
        if self.random.random() < chance:
            content = copy.deepcopy(content)
            self.change(content)
        return self.damaged(pack_object(kind, content), 0.005)

    def change(self, content: dict[str, Any]) -> None:
        node: Any = content
        while True:
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                return
            key = self.random.choice(keys)
            if isinstance(node[key], dict | list) and node[key] and self.random.random() < 0.8:
                node = node[key]
                continue
            how = self.random.random()
            if how < 0.85:
                node[key] = self.random.choice(BAD)
            elif how < 0.95:
                del node[key]
            elif isinstance(node, list):
                node.append(node[key])
            return

    def damaged(self, frame: bytes, chance: float) -> bytes:
        if self.random.random() >= chance:
            return frame
        data = bytearray(frame)
        for _ in range(self.random.randint(1, 3)):
            data[self.random.randrange(len(data))] = self.random.randrange(256)
        return bytes(data)


class World:
    """The server, the simulator and all clients."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.lines: list[str] = []
        self.server = LockstepServer(hang_limit=0.0, connect_limit=0.0, log=self.log, on_digest=self.digest)
        self.server.open_datagram_ports(PORTS)
        host, port = self.server.uri.removeprefix("tcp://").split(":")
        self.address = host, int(port)
        self.now = 0
        self.sent = 0
        self.looks = 0
        self.hostile: list[Client] = []
        self.server.attach_host(Simulator(self))
        topics = [["/t", "std_msgs/String"]]
        self.good = [
            Good(self, GOOD[0], {"publications": topics}),
            Good(self, GOOD[1], {"subscriptions": [*topics, ["/models", "T"]]}),
        ]
        self.good[0].announce((GOOD[1], "/simulator"))
        assert self.server.wait_for(GOOD, 20.0)

    def log(self, _: int, text: str) -> None:
        assert text.isprintable(), f"{text!r} is not one line of text"
        assert len(text) <= LONGEST_LINE
        self.lines[:] = [*self.lines[-20:], text]

    def digest(self, name: str, time_us: int, topics: dict[str, Any]) -> None:
        assert name in self.server.participants
        json.dumps([time_us, topics], allow_nan=False)

    def idle(self, _: float) -> None:
        """Play the clients while the barrier waits."""
        waiting = [participant for participant in self.server.participants.values() if participant.waiting]
        assert self.server._barrier.awaited == len(waiting)
        self.looks += 1
        if self.looks > PATIENCE:
            holding = {participant.address for participant in waiting if participant.name not in GOOD}
            for client in [client for client in self.hostile if address(client.sock) in holding]:
                self.end(client)
        else:
            self.attack()
        for one in self.good:
            one.play()

    def attack(self) -> None:
        while len(self.hostile) < CLIENTS:
            self.hostile.append(Client(self))
        client = self.random.choice(self.hostile)
        try:
            self.sent += client.act()
        except OSError:  # dropped
            self.end(client)
        if self.random.random() < 0.01:
            self.end(client)

    def end(self, client: Client) -> None:
        client.sock.close()
        if client in self.hostile:
            self.hostile.remove(client)

    def tick(self) -> None:
        self.looks = 0
        self.server.tick(self.now, {14540: self.good[0].tick + 1}, self.idle)
        assert set(GOOD) <= set(self.server.participants)
        assert all(one.tick == self.good[0].tick for one in self.good)
        for one in self.good:
            one.reported = one.count
        self.now += BASE_STEP_US

    def settle(self) -> int:
        """Close all but the correct clients and return the size of the server's tables."""
        for client in list(self.hostile):
            self.end(client)
        self.server.poll(0.0)
        while len(self.server.participants) > len(GOOD) or len(self.server._connections) > len(GOOD):
            self.server.poll(1.0)
        self.looks = PATIENCE
        self.server.tick(self.now, {14540: self.good[0].tick + 1}, self.idle)
        for one in self.good:
            one.reported = one.count
        self.now += BASE_STEP_US
        return weight(vars(self.server))


def address(sock: socket.socket) -> str:
    host, port = sock.getsockname()
    return f"{host}:{port}"


def weight(value: object) -> int:
    """Return the number of entries of all tables in a value, including those of its attributes."""
    if isinstance(value, dict):
        return len(value) + sum(weight(one) for one in value.values())
    if isinstance(value, list | tuple | set | frozenset):
        return len(value) + sum(weight(one) for one in value)
    if type(value).__module__.startswith("xtdrone_lockstep"):
        return weight({name: getattr(value, name) for name in getattr(value, "__slots__", None) or vars(value)})
    return 0


@pytest.mark.parametrize("seed", range(SEEDS))
def test_no_client_can_harm_another(seed: int) -> None:
    world = World(seed)
    remembered = None
    while world.sent < FRAMES // SEEDS:
        before = world.sent
        while world.sent < before + FRAMES // SEEDS // 8:
            world.tick()
        now = world.settle()
        assert remembered is None or now == remembered, "what is gone is forgotten"
        remembered = now
    assert world.good[1].known, "the well-behaved have heard each other"
    world.server.close()
    for one in world.good:
        one.sock.close()
