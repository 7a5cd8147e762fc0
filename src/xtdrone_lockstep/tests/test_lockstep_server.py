"""The lockstep protocol and server, with simulated participants over real sockets; no ROS."""

from __future__ import annotations

import itertools
import logging
import math
import os
import random
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import tracemalloc
import zlib
from collections.abc import Callable
from fractions import Fraction
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xtdrone_lockstep import protocol
from xtdrone_lockstep.protocol import FrameReader, Kind, ProtocolError, Schedule
from xtdrone_lockstep.server import LockstepServer, client_sockets, frame_checks, missing_connections, participant
from xtdrone_lockstep.server.barrier import STOPPED
from xtdrone_lockstep.server.frame_checks import Declaration
from xtdrone_lockstep.server.missing_connections import TopicTable

STEP = protocol.BASE_STEP_US
PATIENCE = 120.0  # s of wall time; only a broken run takes so long


class FakeParticipant:
    """Speaks the protocol over a blocking socket."""

    def __init__(self, server: LockstepServer, name: str, rate: float = 30.0, **content) -> None:
        host, port = server.uri.removeprefix("tcp://").split(":")
        self.name = name
        self.sock = socket.create_connection((host, int(port)), timeout=PATIENCE)
        self.reader = FrameReader()
        self.frames: list[tuple[int, bytes]] = []
        self.peers: list[dict] = []
        self.send_object(Kind.JOIN, {"version": protocol.VERSION, "name": name, "rate": rate, **content})

    def send_object(self, kind: Kind, content: dict) -> None:
        self.sock.sendall(protocol.pack_object(kind, content))

    def next(self) -> tuple[int, bytes]:
        while not self.frames:
            data = self.sock.recv(65536)
            if not data:
                raise EOFError
            self.reader.feed(data)
            self.frames.extend(self.reader.frames())
        return self.frames.pop(0)

    def expect(self, kind: Kind) -> dict:
        got, payload = self.next()
        assert got == kind
        return protocol.unpack_object(payload)

    def tick(self) -> protocol.Barrier:
        while True:
            kind, payload = self.next()
            if kind == Kind.PEER:
                self.peers.append(protocol.unpack_object(payload))
                continue
            assert kind == Kind.TICK
            return protocol.unpack_barrier(payload)

    def done(self, tick: protocol.Barrier, channels=None, datagrams=None) -> None:
        self.sock.sendall(protocol.pack_barrier(Kind.DONE, tick.tick, tick.time_us, channels or {}, datagrams or {}))

    def made(self, number: int, topic: str, subscriber: str, port: int = 1000, count: int = 0) -> None:
        self.send_object(Kind.PEER, {"made": [[number, topic, subscriber, port, count]], "lost": []})


class Log:
    def __init__(self) -> None:
        self.lines: list[tuple[int, str]] = []

    def __call__(self, level: int, text: str) -> None:
        self.lines.append((level, text))

    def warnings(self) -> str:
        return "\n".join(text for level, text in self.lines if level >= logging.WARNING)


@pytest.fixture
def log():
    return Log()


@pytest.fixture
def server(log):
    server = LockstepServer(connect_limit=PATIENCE, log=log)
    yield server
    server.close()


def joined(server: LockstepServer, *players: FakeParticipant) -> None:
    assert server.wait_for([player.name for player in players], timeout=PATIENCE)
    for player in players:
        player.expect(Kind.WELCOME)


def answered(server: LockstepServer, *players: FakeParticipant) -> None:
    """Poll the server until each player has an answer to read."""
    end = time.monotonic() + PATIENCE
    for player in players:
        while not select.select([player.sock], [], [], 0.0)[0]:
            assert time.monotonic() < end, f"no answer for {player.name}"
            server.poll(0.05)


class Running:
    """One barrier in a separate thread, so that the test can play the participants."""

    def __init__(self, server: LockstepServer, now_us: int, **options) -> None:
        self.thread = threading.Thread(target=server.tick, args=(now_us,), kwargs=options, daemon=True)

    def __enter__(self) -> Running:
        self.thread.start()
        return self

    def __exit__(self, *error) -> None:
        self.thread.join(PATIENCE)
        assert not self.thread.is_alive(), "the barrier does not end"


# ---- protocol ----


def test_barrier_frames_are_read_from_any_fragments():
    random.seed(7)
    barriers = [
        protocol.Barrier(
            tick,
            tick * STEP - 4000,
            {random.randrange(1 << 32): random.randrange(1 << 63) for _ in range(tick % 7)},
            {random.randrange(1, 65536): random.randrange(1 << 40) for _ in range(tick % 3)},
        )
        for tick in range(1, 40)
    ]
    stream = b"".join(protocol.pack_barrier(Kind.DONE, *barrier) for barrier in barriers)
    reader = FrameReader()
    frames = []
    while stream:
        cut = random.randrange(1, 50)
        reader.feed(stream[:cut])
        stream = stream[cut:]
        frames.extend(reader.frames())
    assert [kind for kind, _ in frames] == [Kind.DONE] * len(barriers)
    assert [protocol.unpack_barrier(payload) for _, payload in frames] == barriers


def test_frame_layout_matches_the_documentation():
    frame = protocol.pack_barrier(Kind.TICK, 3, 12000, {5: 6}, {14540: 9})
    assert frame == struct.pack("<IBQqIIIQIQ", 1 + 24 + 24, 7, 3, 12000, 1, 1, 5, 6, 14540, 9)


@pytest.mark.parametrize("data", [b"\0\0\0\0\1", b"\xff\xff\xff\xff\1", b"\1\0\0\0\x63"])
def test_invalid_length_raises(data):
    reader = FrameReader()
    reader.feed(data)
    with pytest.raises(ProtocolError, match="allowed"):
        list(reader.frames())


def test_reader_checks_the_header_before_the_payload_arrives():
    reader = FrameReader(frame_checks.BEFORE_JOIN)
    reader.feed(struct.pack("<IB", frame_checks.LONGEST_RESERVE + 1, Kind.RESERVE))
    with pytest.raises(ProtocolError, match=f"allowed are 1 to {frame_checks.LONGEST_RESERVE}"):
        list(reader.frames())


def test_long_barrier_frames_do_not_leak_memory():
    """No cache is kept per length of a frame, since the sender chooses the length."""
    whole = [protocol.pack_barrier(Kind.DONE, 1, 0, {i: i for i in range(n)}, {})[5:] for n in (40_000, 40_001, 40_002)]
    protocol.unpack_barrier(whole[0])
    tracemalloc.start()
    for payload in whole:
        protocol.unpack_barrier(payload)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < 100_000


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("all is well, \u00e4", "all is well, \u00e4"),
        ("one\ntwo\x1b[2J\x07", "one\\ntwo\\x1b[2J\\x07"),
        ("\ud800 \u202e", "\\ud800 \\u202e"),
        ("x" * 300, "x" * 197 + "..."),
    ],
)
def test_text_of_a_peer_becomes_one_printable_line(text, shown):
    assert protocol.printable(text) == shown
    assert protocol.printable("\n" * 1000, 40) == "\\n" * 18 + "\\..."


@pytest.mark.parametrize(
    ("read", "content", "text"),
    [
        (frame_checks.join, {"rate": 10**400}, "/a: rate 1000"),
        (frame_checks.join, {"rate": True}, "/a: rate True: must be above 0"),
        (frame_checks.join, {"udp_ports": [math.inf]}, "JOIN: UDP port inf: must be an integer from 1 to 65535"),
        (frame_checks.join, {"pid": 10**400}, "JOIN: pid 1000"),
        (frame_checks.join, {"name": "/a\n[WARN]"}, r"name '/a\\n\[WARN\]': must be a resolved ROS name"),
        (frame_checks.join, {"name": "/" + "a" * 256}, "of at most 256 characters"),
        (frame_checks.join, {"publications": [["/x\x1b", "T"]]}, r"JOIN: publications: topic '/x\\x1b': must be a"),
        (frame_checks.join, {"publications": [["/x", "T\n"]]}, r"JOIN: publications: type 'T\\n': must be a ROS type"),
        (frame_checks.join, {"subscriptions": {"/x": "T"}}, "JOIN: subscriptions an object of 1: must be a list"),
        (frame_checks.peers, {"made": [[1, "/x", "/b", 1000, "abc"]]}, "PEER: count 'abc': must be an integer"),
        (frame_checks.peers, {"made": [[1, "/x", "/b", 1000, -5]]}, "PEER: count -5: must be an integer from 0 to"),
        (
            frame_checks.peers,
            {"made": [[1, [], "/b", 1000, 0]]},
            "PEER: topic a list of 0: must be a resolved ROS name",
        ),
        (frame_checks.peers, {"lost": [[]]}, "PEER: number a list of 0: must be an integer"),
        (frame_checks.digest, {"time_us": math.inf, "topics": {}}, "DIGEST: time_us inf: must be an integer"),
        (frame_checks.digest, {"time_us": 0, "topics": {"/x": [1, 2, 1 << 32]}}, "DIGEST: number 4294967296: must be"),
        (frame_checks.leave, {"reason": 5}, "LEAVE: reason 5, failed False: must be a string and a boolean"),
    ],
)
def test_error_names_the_invalid_field(read, content, text):
    whole = {"version": protocol.VERSION, "name": "/a", "rate": 30, **content} if read is frame_checks.join else content
    with pytest.raises(ProtocolError, match=text):
        read(protocol.pack_object(Kind.JOIN, whole)[5:])


def test_invalid_name_of_a_foreign_subscriber_is_accepted():
    content = {"made": [[1, "/x", "a stranger\n", 1000, 0]], "lost": []}
    assert frame_checks.peers(protocol.pack_object(Kind.PEER, content)[5:]).made == [
        frame_checks.Made(1, "/x", "", 1000, 0)
    ]


def test_invalid_payloads_raise():
    whole = protocol.pack_barrier(Kind.TICK, 3, 12000, {5: 6}, {})[5:]
    for payload in (whole[:-1], whole + b"\0", b""):
        with pytest.raises(ProtocolError):
            protocol.unpack_barrier(payload)
    for payload in (b"", b"[1]", b"\xff"):
        with pytest.raises(ProtocolError):
            protocol.unpack_object(payload)


# ---- due times ----


def test_due_times_satisfy_their_definition():
    random.seed(11)
    rates = [250.0, 30.0, 0.1, 29.97, 1 / 3, 249.999, 100.0, 7.0] + [random.uniform(0.01, 250.0) for _ in range(60)]
    for rate in rates:
        schedule = Schedule(rate)
        exact = Fraction(rate).limit_denominator(1_000_000)
        previous = -STEP
        for index in [*range(40), *sorted(random.randrange(10**6) for _ in range(20))]:
            due = schedule.due_us(index)
            assert due % STEP == 0
            wanted = Fraction(index * 1_000_000) / exact
            assert wanted <= due < wanted + STEP
            assert due > previous
            previous = due
            # The function returns the next due time after any earlier time, followed by that of the next index.
            assert schedule.after_us(due - 1) == due
            assert schedule.after_us(due) == schedule.due_us(index + 1)


def test_thirty_hertz_means_thirty_turns_per_second():
    schedule = Schedule(30.0)
    times, now = [], -1
    while (now := schedule.after_us(now)) < 10_000_000:
        times.append(now)
    assert len(times) == 300
    assert times[:5] == [0, 36000, 68000, 100000, 136000]


@pytest.mark.parametrize("rate", [0, -1.0, 250.1, float("nan"), float("inf"), "30", None])
def test_rate_out_of_range_raises(rate):
    with pytest.raises(ValueError, match="must be above 0 and at most 250 Hz"):
        Schedule(rate)


# ---- topics ----

_DECLARED = st.dictionaries(st.sampled_from(["/x", "/y", "/z"]), st.sampled_from(["T", "U", "*"]))


@given(st.lists(st.tuples(st.sampled_from("abc"), _DECLARED, _DECLARED), max_size=12))
def test_required_connections_are_those_of_common_topics(declared):
    topics, now = TopicTable(), {}
    for name, publications, subscriptions in declared:
        if name in now and not publications and not subscriptions:
            topics.remove(name)
            del now[name]
            continue
        topics.declare(name, Declaration(publications, subscriptions))
        now[name] = Declaration(publications, subscriptions)
        wanted = {
            ((topic, one, other), now[one].publications[topic], now[other].subscriptions[topic])
            for one in now
            for other in now
            for topic in now[one].publications.keys() & now[other].subscriptions.keys()
            if name in (one, other)
        }
        assert set(topics.pairs(name)) == wanted


def test_long_news_is_split_with_each_connection_before_its_loss(monkeypatch):
    monkeypatch.setattr(participant, "MOST_NEWS_PER_FRAME", 2)
    news = participant.News()
    news.made = [[number, "/x", "/a", 1000] for number in range(5)]
    news.lost, news.counted, news.reset, news.void = [4], [7], True, [[0, 1], [1, 1], [2, 1]]
    peers = news.take_peers()
    assert [len(content["made"]) for content in peers] == [2, 2, 1, 0, 0]
    assert [content["lost"] for content in peers] == [[], [], [], [4], []]
    assert [content.get("void") for content in peers] == [None, None, None, [[0, 1], [1, 1]], [[2, 1]]]
    assert [content.get("reset") for content in peers] == [None] * 4 + [True]
    assert news.take_peers() == []


# ---- joining ----


def test_start_reports_missing_participants(server):
    reported = []
    assert not server.wait_for(["/a", "b"], timeout=0.0, progress=reported.append)
    assert reported == ["2 of 2 participants have not joined: /a, /b"]
    assert not server.wait_for(1, timeout=0.0, progress=reported.append)
    assert reported[-1] == "0 of 1 participants have joined"
    _a = FakeParticipant(server, "/a")
    assert server.wait_for(1, timeout=PATIENCE)
    assert server.missing(["a"]) == ""


def test_start_waits_for_connections_between_declared_topics(server):
    a = FakeParticipant(server, "/a", publications=[["/x", "T"], ["/y", "T"]])
    b = FakeParticipant(server, "/b", subscriptions=[["/x", "T"]])
    reported = []
    while len(server.participants) < 2:
        server.poll(PATIENCE)
    assert not server.wait_for(2, timeout=0.0, progress=reported.append)
    assert reported[-1] == "1 connections are not made: /x from /a to /b"
    a.expect(Kind.WELCOME)
    a.made(1, "/x", "/b")
    assert server.wait_for(2, timeout=PATIENCE, progress=reported.append)
    with Running(server, 0):
        b.expect(Kind.WELCOME)
        b.done(b.tick())
        a.done(a.tick())
    assert b.peers == [{"made": [[1, "/x", "/a", 1000]], "lost": [], "counted": [], "uncounted": []}]
    assert a.peers == [{"made": [], "lost": [], "counted": [1], "uncounted": []}]


def test_a_connection_that_is_never_made_is_asked_for_again_before_a_warning(log, monkeypatch):
    monkeypatch.setattr(missing_connections, "ASK_PERIOD", 0.0)
    server = LockstepServer(connect_limit=0.2, log=log)
    _a = FakeParticipant(server, "/a", publications=[["/x", "T"], ["/y", "T"]])
    b = FakeParticipant(server, "/b", subscriptions=[["/x", "T"]])
    told: list[list[str]] = []
    changes = itertools.chain([({"subscriptions": [["/y", "T"]]}, [], [], {})], itertools.repeat((None, [], [], {})))
    server.attach_host(SimpleNamespace(name="/s", collect=lambda: next(changes), connect_again=told.append))
    assert server.wait_for(2, timeout=PATIENCE)
    warnings = log.warnings()
    assert "no connection of /x from /a to /b within 0.2 s, though the master was asked again" in warnings
    assert "no connection of /y from /a to /s within 0.2 s, though the master was asked again" in warnings
    b.expect(Kind.WELCOME)
    assert b.expect(Kind.PEER)["missing"] == ["/x"]
    assert told[0] == ["/y"]
    server.close()


def test_type_mismatch_is_reported_and_not_waited_for(server, log):
    _a = FakeParticipant(server, "/a", publications=[["/x", "T"]])
    _b = FakeParticipant(server, "/b", subscriptions=[["/x", "U"]])
    assert server.wait_for(2, timeout=PATIENCE)
    assert "/x: /a publishes T, /b subscribes to U" in log.warnings()


@pytest.mark.parametrize(
    ("change", "code", "text"),
    [
        ({"version": 99}, "version", "version 99"),
        ({"name": "b"}, "name", "must be a resolved ROS name"),
        ({"name": "/b\n[WARN] forged"}, "name", "name '/b\\n[WARN] forged': must be a resolved ROS name"),
        ({"rate": 300}, "rate", "at most 250 Hz"),
        ({"name": "/a"}, "taken", "the name /a is taken by a participant connected from 127.0.0.1"),
    ],
)
def test_rejection_has_the_reason(server, change, code, text):
    a = FakeParticipant(server, "/a")
    joined(server, a)
    content = {"name": "/b", "rate": 30.0, **change}
    b = FakeParticipant(server, content.pop("name"), content.pop("rate"), **content)
    answered(server, b)
    refusal = b.expect(Kind.REFUSED)
    assert refusal["code"] == code
    assert text in refusal["reason"]
    with pytest.raises(EOFError):
        b.next()
    assert list(server.participants) == ["/a"]


@pytest.mark.parametrize(
    "garbage",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        protocol.pack_object(Kind.PEER, {}),
        protocol.pack_object(Kind.JOIN, {"version": protocol.VERSION, "name": "/g", "rate": 1, "publications": 5}),
        protocol.ALIVE_FRAME[:4] + b"\x63",
    ],
)
def test_garbage_closes_only_its_own_connection(server, log, garbage):
    a = FakeParticipant(server, "/a")
    joined(server, a)
    host, port = server.uri.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port))) as sock:
        sock.sendall(garbage)
        end = time.monotonic() + PATIENCE
        while "invalid lockstep frame" not in log.warnings() and time.monotonic() < end:
            server.poll(0.1)
    assert "invalid lockstep frame" in log.warnings()
    with Running(server, 0):
        a.done(a.tick())
    assert list(server.participants) == ["/a"]


class Stranger(FakeParticipant):
    """A client that sends only the bytes that the test chooses."""

    def __init__(self, server: LockstepServer) -> None:
        host, port = server.uri.removeprefix("tcp://").split(":")
        self.name = ""
        self.sock = socket.create_connection((host, int(port)), timeout=PATIENCE)
        self.reader = FrameReader()
        self.frames = []
        self.peers = []

    def is_closed(self) -> bool:
        self.sock.settimeout(0.0)
        try:
            while self.sock.recv(65536):
                pass
        except BlockingIOError:
            return False
        except ConnectionResetError:
            return True
        return True


def poll_until(server: LockstepServer, condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < end, "it does not come to that"
        server.poll(0.05)


@pytest.mark.parametrize(
    "frame",
    [
        protocol.pack_barrier(Kind.DONE, 0, 0, {}, {14580: 1000}),
        protocol.ALIVE_FRAME,
        protocol.pack_object(Kind.LEAVE, {"reason": "it crashed", "failed": True}),
        protocol.pack_object(Kind.RESERVE, {"name": "/a" * 5000}),
    ],
)
def test_only_small_reserve_and_join_frames_are_accepted_before_joining(server, log, frame):
    server.open_datagram_ports([14580])
    stranger = Stranger(server)
    stranger.sock.sendall(frame)
    poll_until(server, stranger.is_closed)
    assert server.datagrams_expected == {}
    assert "invalid lockstep frame" in log.warnings()


def test_reservation_expires_unless_its_process_lives(server, monkeypatch, log):
    monkeypatch.setattr(client_sockets, "RESERVATION_LIMIT", 0.0)
    monkeypatch.setattr(client_sockets, "CHECK_PERIOD", 0.0)
    process = subprocess.Popen(["sleep", "60"])
    stranger, starting = Reserving(server, "/a"), Reserving(server, "/b", **own(process.pid))
    poll_until(server, stranger.is_closed)
    server.poll(0.0)
    assert not starting.is_closed()
    starting.sock.settimeout(5.0)
    joined(server, FakeParticipant(server, "/a"))
    late = FakeParticipant(server, "/b")
    server.poll(1.0)
    assert late.expect(Kind.REFUSED)["code"] == "taken"
    process.kill()  # a child process may hold the connection
    process.wait()
    poll_until(server, starting.is_closed)
    joined(server, FakeParticipant(server, "/b"))


def test_newcomers_are_closed_after_a_time_limit_or_for_newer_ones(server, monkeypatch):
    monkeypatch.setattr(client_sockets, "MOST_NEWCOMERS", 5)
    strangers = [Stranger(server) for _ in range(8)]
    poll_until(server, lambda: sum(one.is_closed() for one in strangers) >= 3)
    assert [one.is_closed() for one in strangers] == [True] * 3 + [False] * 5
    a = FakeParticipant(server, "/a")
    joined(server, a)
    monkeypatch.setattr(client_sockets, "GREETING_LIMIT", 0.0)
    monkeypatch.setattr(client_sockets, "CHECK_PERIOD", 0.0)
    poll_until(server, lambda: all(one.is_closed() for one in strangers))
    assert list(server.participants) == ["/a"]


def test_connections_per_address_are_limited(server, monkeypatch):
    monkeypatch.setattr(client_sockets, "MOST_PER_ADDRESS", 2)
    a, b = FakeParticipant(server, "/a"), FakeParticipant(server, "/b")
    joined(server, a, b)
    c = FakeParticipant(server, "/c")
    server.poll(1.0)
    refusal = c.expect(Kind.REFUSED)
    assert (refusal["code"], "the limit is 2 per address" in refusal["reason"]) == ("full", True)
    a.sock.close()
    poll_until(server, lambda: "/a" not in server.participants)
    joined(server, FakeParticipant(server, "/c"))


def test_incomplete_frames_are_limited_in_total_and_the_longest_is_closed(server, monkeypatch):
    monkeypatch.setattr(client_sockets, "MOST_UNFINISHED", 300_000)
    sizes = (120_000, 150_000, 100_000)
    strangers = [Stranger(server) for _ in sizes]
    for stranger, size in zip(strangers, sizes, strict=True):
        stranger.sock.sendall(struct.pack("<IB", frame_checks.LONGEST_JOIN, Kind.JOIN) + bytes(size))
    poll_until(server, lambda: any(one.is_closed() for one in strangers))
    assert [one.is_closed() for one in strangers].count(True) == 1
    assert not strangers[2].is_closed(), "the shortest"


def test_participants_are_served_before_newcomers(server, monkeypatch):
    """Newcomers get a limited part of a poll; frames of participants come first."""
    a = FakeParticipant(server, "/a")
    joined(server, a)
    monkeypatch.setattr(client_sockets, "GREETING_BUDGET", 0.0)
    crowd = [FakeParticipant(server, f"/n{i}", publications=[["/x", "T"]]) for i in range(20)]
    with Running(server, 0):
        a.done(a.tick())
    assert list(server.participants) == ["/a"]
    monkeypatch.setattr(client_sockets, "GREETING_BUDGET", 5.0)
    joined(server, *crowd)


def test_many_frames_of_one_participant_are_handled_in_parts(server):
    a, b = FakeParticipant(server, "/a"), FakeParticipant(server, "/b")
    joined(server, a, b)
    count = 3 * client_sockets.FRAMES_PER_POLL
    alive = protocol.NEEDS_TIME_FRAME * (count - 1) + protocol.ALIVE_FRAME
    a.sock.sendall(alive)
    poll_until(server, lambda: server.needs_time)
    assert select.select([server.fileno()], [], [], 0.0)[0], "there is more to do, though nothing has come"
    server.poll(0.0)
    assert server.needs_time
    server.poll(0.0)
    assert not server.needs_time, "all of it is taken in the end"
    assert not select.select([server.fileno()], [], [], 0.0)[0]
    with Running(server, 0):
        b.done(b.tick())
        a.done(a.tick())


def test_unread_data_of_a_participant_is_limited(server, monkeypatch, log):
    monkeypatch.setattr(client_sockets, "MOST_UNSENT", 1 << 16)
    a = FakeParticipant(server, "/a", rate=250.0)
    b = FakeParticipant(server, "/b", rate=250.0)
    joined(server, a, b)
    a.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    server.participants["/a"].connection.sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    number = tick = 0
    while "/a" in server.participants:
        made = [[number + i, "/x", "/a", 1000, 0] for i in range(2000)]
        b.send_object(Kind.PEER, {"made": made, "lost": [row[0] - 2000 for row in made if number]})
        number += 2000
        with Running(server, STEP * tick):
            tick += 1
            b.done(b.tick())
            try:  # it sends DONE without reading
                a.sock.sendall(protocol.pack_barrier(Kind.DONE, tick, 0, {}, {}))
            except OSError:
                break
    assert "/a does not read: " in log.warnings()


def test_warnings_about_newcomers_are_rate_limited(server, log):
    strangers = [Stranger(server) for _ in range(10)]
    for stranger in strangers:
        stranger.sock.sendall(b"GET / HTTP/1.1\r\n\r\n")
    poll_until(server, lambda: all(one.is_closed() for one in strangers))
    assert log.warnings().count("\n") == 0


def test_reasons_are_logged_as_one_printable_line(server, log):
    a = FakeParticipant(server, "/a")
    joined(server, a)
    crash = "it crashed: KeyError: 'x'\n[WARN] [1.0]: simulator: participant /b is gone\x1b[2J"
    a.send_object(Kind.LEAVE, {"reason": crash, "failed": True})
    server.poll(1.0)
    line = "participant /a leaves: it crashed: KeyError: 'x'\\n[WARN] [1.0]: simulator: participant /b is gone"
    assert log.warnings() == line + "\\x1b[2J"


@pytest.mark.parametrize(
    ("failure", "reason"),
    [("", "the simulation has ended"), ("RuntimeError: a\nb", "the simulation has failed: RuntimeError: a\\nb")],
)
def test_leave_reports_whether_the_simulator_has_failed(server, failure, reason):
    a = FakeParticipant(server, "/a")
    joined(server, a)
    server.close(failure)
    assert a.expect(Kind.LEAVE) == {"reason": reason, "failed": bool(failure)}


def test_decreasing_datagram_count_is_rejected(server, log):
    server.open_datagram_ports([14580])
    a = FakeParticipant(server, "/a")
    joined(server, a)
    with Running(server, 0):
        a.done(a.tick(), datagrams={14580: 5})
    with Running(server, 36000):
        a.done(a.tick(), datagrams={14580: 4})
    assert "DONE: 4 datagrams to port 14580, after 5 before" in log.warnings()
    assert server.datagrams_expected == {14580: 5}


def test_counts_for_a_late_participant_begin_when_it_joins(server):
    """Datagrams sent since the last tick may not have found an open socket."""
    sent = {24540: 3}
    server.open_datagram_ports([14580], lambda: sent)
    a = FakeParticipant(server, "/a")
    joined(server, a)
    with Running(server, 0, datagrams=dict(sent)):
        sent[24540] = 5  # while the world advances to the next tick
        a.done(a.tick())
    late = FakeParticipant(server, "/late", udp_ports=[24540])
    joined(server, late)
    sent[24540] = 7
    with Running(server, 36000, datagrams=dict(sent)):
        tick = late.tick()
        assert tick.datagrams == {24540: 2}
        assert server.begins_counts
        late.done(tick)
        a.done(a.tick())
    sent[24540] = 8
    with Running(server, 72000, datagrams=dict(sent)):
        tick = late.tick()
        assert tick.datagrams == {24540: 3}
        assert not server.begins_counts
        late.done(tick)
        a.done(a.tick())


# ---- barrier ----


def test_each_participant_is_due_at_its_own_rate(server):
    rates = {"/slow": 10.0, "/usual": 30.0, "/fast": 250.0}
    players = {name: FakeParticipant(server, name, rate) for name, rate in rates.items()}
    joined(server, *players.values())
    seen: dict[str, list[int]] = {name: [] for name in rates}

    def play(name: str) -> None:
        while len(seen[name]) < rates[name] // 2:
            tick = players[name].tick()
            seen[name].append(tick.time_us)
            players[name].done(tick)

    threads = [threading.Thread(target=play, args=(name,), daemon=True) for name in rates]
    for thread in threads:
        thread.start()
    now = 0
    while now < 500_000:
        server.tick(now)
        now = server.next_due_us(now)
    for thread in threads:
        thread.join(PATIENCE)
    for name, rate in rates.items():
        assert seen[name] == [Schedule(rate).due_us(index) for index in range(int(rate // 2))]


def test_without_participants_nothing_is_due(server):
    assert server.next_due_us(0) is None
    server.tick(0)


def test_counts_are_sent_with_the_next_tick_and_only_if_changed(server):
    a = FakeParticipant(server, "/a", publications=[["/x", "T"]])
    b = FakeParticipant(server, "/b", subscriptions=[["/x", "T"]])
    a.made(7, "/x", "/b", count=1)
    a.made(8, "/x", "/rosbag", port=1001)
    joined(server, a, b)
    with Running(server, 0):
        first = b.tick()
        b.done(first)
        a.done(a.tick(), {7: 3, 8: 3})
    with Running(server, 36000):
        second = b.tick()
        b.done(second)
        a.done(a.tick())
    with Running(server, 68000):
        third = b.tick()
        b.done(third)
        a.done(a.tick())
    [channel] = [entry[0] for peer in b.peers for entry in peer["made"]]
    assert first.channels == {channel: 1}  # latched before the first tick
    assert second.channels == {channel: 3}
    assert third.channels == {}
    assert (second.tick, second.time_us) == (first.tick + 1, 36000)


def test_late_join_holds_the_simulation_until_connected(log):
    server = LockstepServer(connect_limit=PATIENCE, log=log)
    a = FakeParticipant(server, "/a", publications=[["/x", "T"]])
    joined(server, a)
    with Running(server, 0):
        a.done(a.tick())
    b = FakeParticipant(server, "/b", rate=250.0, subscriptions=[["/x", "T"]])
    with Running(server, 36000):
        b.expect(Kind.WELCOME)
        a.sock.settimeout(0.3)
        with pytest.raises(TimeoutError):
            a.next()
        a.sock.settimeout(PATIENCE)
        a.made(1, "/x", "/b")
        a.done(a.tick())
        late = b.tick()
        b.done(late)
    assert late.time_us == 36000
    assert server.next_due_us(36000) == 40000
    server.close()


def test_closed_connection_is_dropped_at_once_and_the_others_continue(server, log):
    a = FakeParticipant(server, "/a", publications=[["/x", "T"]])
    b = FakeParticipant(server, "/b", subscriptions=[["/x", "T"]])
    a.made(1, "/x", "/b")
    joined(server, a, b)
    with Running(server, 0):
        b.done(b.tick())
        a.tick()
        a.sock.close()
    assert list(server.participants) == ["/b"]
    assert "participant /a is gone" in log.warnings()
    with Running(server, 36000):
        b.done(b.tick())
    assert [peer["lost"] for peer in b.peers if peer["lost"]] == [[1]]
    # The name is free again.
    joined(server, FakeParticipant(server, "/a"))


def test_leave_causes_no_warning(server, log):
    a = FakeParticipant(server, "/a")
    joined(server, a)
    a.send_object(Kind.LEAVE, {"reason": "shut down"})
    server.poll(PATIENCE)
    assert not server.participants
    assert log.warnings() == ""


def test_silent_participant_is_dropped_after_the_hang_limit(log):
    server = LockstepServer(hang_limit=1.5, log=log)  # enough time for /a even on a starved machine
    a, b = FakeParticipant(server, "/a"), FakeParticipant(server, "/b")
    joined(server, a, b)
    with Running(server, 0):
        a.done(a.tick())
        b.tick()
    assert list(server.participants) == ["/a"]
    assert "/b was silent for" in log.warnings()
    assert "silent" in b.expect(Kind.REFUSED)["reason"]
    server.close()


def test_silence_while_the_simulator_was_stopped_is_excused():
    script = f"""
import sys
sys.path.insert(0, {os.path.dirname(__file__)!r})
from test_lockstep_server import FakeParticipant, LockstepServer
server = LockstepServer(hang_limit=0.5, busy_limit=1.5, log=lambda level, text: print(text, flush=True))
print(server.uri, flush=True)
assert server.wait_for(["/a"], timeout=30.0)
print("ticks", flush=True)
server.tick(0)
print(*server.participants, flush=True)
"""
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    a = FakeParticipant(SimpleNamespace(uri=process.stdout.readline().strip()), "/a")
    a.expect(Kind.WELCOME)
    while process.stdout.readline() != "ticks\n":
        pass
    tick = a.tick()
    process.send_signal(signal.SIGSTOP)
    time.sleep(STOPPED + 0.5)
    process.send_signal(signal.SIGCONT)
    assert "did not run for" in process.stdout.readline()
    a.done(tick)
    assert process.stdout.readline() == "/a\n"
    assert process.wait(10.0) == 0
    process.stdout.close()


def test_keep_alives_postpone_the_hang_limit_but_not_the_busy_limit(log):
    server = LockstepServer(hang_limit=1.0, busy_limit=1.5, log=log)
    a = FakeParticipant(server, "/a")
    joined(server, a)
    started = time.monotonic()
    with Running(server, 0) as running:
        a.tick()
        while running.thread.is_alive():
            try:
                a.sock.sendall(protocol.ALIVE_FRAME)
            except OSError:
                break
            running.thread.join(0.05)
    assert time.monotonic() - started > 1.5
    assert "/a took more than 1.5 s for one tick" in log.warnings()
    server.close()


def own(pid: int) -> dict:
    """Return the JOIN fields that identify a process on this machine."""
    return {"pid": pid, "host": protocol.process_namespace()}


def test_need_for_time_is_reported_while_the_barrier_waits(server):
    a, b = FakeParticipant(server, "/a"), FakeParticipant(server, "/b")
    joined(server, a, b)
    assert not server.needs_time
    seen = []
    with Running(server, 10 * STEP, idle=lambda timeout: seen.append(server.needs_time) or time.sleep(0.001)):
        tick = a.tick()
        b.done(b.tick())
        for frame, needs in ((protocol.NEEDS_TIME_FRAME, True), (protocol.ALIVE_FRAME, False)):
            a.sock.sendall(frame)
            end = time.monotonic() + PATIENCE
            while not seen or seen[-1] is not needs:
                assert time.monotonic() < end, seen
        a.sock.sendall(protocol.NEEDS_TIME_FRAME)
        a.done(tick)
    assert server.needs_time
    a.sock.close()
    server.poll(PATIENCE)
    assert not server.needs_time


def test_dead_process_is_detected_while_another_holds_its_connection(log):
    server = LockstepServer(hang_limit=60.0, log=log)
    process = subprocess.Popen(["sleep", "60"])
    a, b = FakeParticipant(server, "/a"), FakeParticipant(server, "/b", **own(process.pid))
    joined(server, a, b)
    with Running(server, 0):
        a.done(a.tick())
        b.tick()
        process.kill()
        process.wait()
    assert f"/b is gone: its process {process.pid} has ended" in log.warnings()
    assert list(server.participants) == ["/a"]
    server.close()


def test_zombie_process_is_dropped(log):
    server = LockstepServer(hang_limit=60.0, log=log)
    process = subprocess.Popen(["sleep", "60"])
    b = FakeParticipant(server, "/b", **own(process.pid))
    joined(server, b)
    with Running(server, 0):
        b.tick()
        process.kill()  # without reading its exit status
    assert not server.participants
    process.wait()
    server.close()


def test_process_stopped_by_a_debugger_is_not_dropped(log):
    """A debugger such as gdb stops all threads, including the one that sends keep-alives; the server keeps waiting."""
    server = LockstepServer(hang_limit=0.2, log=log)
    traced = "import ctypes, os, signal; ctypes.CDLL(None).ptrace(0, 0, 0, 0); os.kill(os.getpid(), signal.SIGSTOP)"
    process = subprocess.Popen([sys.executable, "-c", traced])  # 0: PTRACE_TRACEME, this process is the debugger
    os.waitpid(process.pid, os.WUNTRACED)
    b = FakeParticipant(server, "/b", **own(process.pid))
    joined(server, b)
    with Running(server, 0) as running:
        tick = b.tick()
        running.thread.join(1.0)
        assert running.thread.is_alive()
        b.done(tick)
    assert list(server.participants) == ["/b"]
    assert not log.warnings()
    process.kill()
    process.wait()
    server.close()


def test_process_on_another_machine_is_not_checked(log):
    server = LockstepServer(hang_limit=0.3, log=log)
    b = FakeParticipant(server, "/b", pid=1, host="another boot, another namespace")
    joined(server, b)
    with Running(server, 0):
        b.tick()
    assert "silent" in log.warnings()
    server.close()


class Reserving(Stranger):
    """A client that reserves its name first."""

    def __init__(self, server: LockstepServer, name: str, **content) -> None:
        super().__init__(server)
        self.name = name
        self.send_object(Kind.RESERVE, {"version": protocol.VERSION, "name": name, **content})


def test_reserved_name_is_held_until_its_owner_joins_or_disconnects(server, log):
    first, second = Reserving(server, "/a"), Reserving(server, "/a")
    answered(server, first, second)
    first.expect(Kind.WELCOME)
    assert second.expect(Kind.REFUSED)["code"] == "taken"
    assert not server.participants, "a reservation is no participant"
    intruder = FakeParticipant(server, "/a")
    answered(server, intruder)
    assert intruder.expect(Kind.REFUSED)["code"] == "taken"
    first.send_object(Kind.JOIN, {"version": protocol.VERSION, "name": "/a", "rate": 30.0})
    joined(server, first)
    late = Reserving(server, "/a")
    answered(server, late)
    assert late.expect(Kind.REFUSED)["code"] == "taken"
    first.sock.close()
    server.poll(PATIENCE)
    again = Reserving(server, "/a")
    answered(server, again)
    again.expect(Kind.WELCOME)
    again.sock.close()
    server.poll(PATIENCE)
    joined(server, FakeParticipant(server, "/a"))


def test_digests_are_requested_and_passed_on(log):
    got = []
    server = LockstepServer(log=log, on_digest=lambda *content: got.append(content))
    a = FakeParticipant(server, "/a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    assert a.expect(Kind.WELCOME)["digest"] is True
    a.send_object(Kind.DIGEST, {"time_us": 1_000_000, "topics": {"/x": [3, 40, 0xFFFFFFFF]}})
    server.poll(PATIENCE)
    assert got == [("/a", 1_000_000, {"/x": [3, 40, 0xFFFFFFFF]})]
    server.close()


@given(st.lists(st.tuples(st.integers(0, 2**60), st.binary(max_size=50)), max_size=20))
def test_digest_is_the_checksum_of_the_concatenation(messages):
    digest, whole = protocol.Digest(), b""
    for time_us, message in messages:
        digest.add(time_us, message)
        whole += struct.pack("<qI", time_us, len(message)) + message
    assert digest.state() == [len(messages), sum(len(m) for _, m in messages), zlib.crc32(whole)]


def test_datagrams_are_counted_both_ways(server):
    server.open_datagram_ports([14580, 14581])
    a = FakeParticipant(server, "/a", udp_ports=[14540, 14541])
    b = FakeParticipant(server, "/b")
    joined(server, a, b)
    with Running(server, 0, datagrams={14540: 2, 9: 9}):
        first = a.tick()
        a.done(first, datagrams={14580: 5, 14999: 7})  # the last is not a port of the simulator
        b.done(b.tick(), datagrams={14580: 1, 14581: 4})
    assert first.datagrams == {14540: 2}
    assert server.datagrams_expected == {14580: 6, 14581: 4}
    with Running(server, 36000, datagrams={14540: 2, 14541: 1}):
        second = a.tick()
        a.done(second, datagrams={14580: 7})
        b.sock.close()
    assert second.datagrams == {14541: 1}
    assert server.datagrams_expected == {14580: 8, 14581: 4}
    # A later participant cannot have received earlier datagrams.
    c = FakeParticipant(server, "/c", udp_ports=[14540])
    with Running(server, 68000, datagrams={14540: 3, 14541: 1}):
        c.expect(Kind.WELCOME)
        a.done(a.tick())
        tick = c.tick()
        c.done(tick)
    assert tick.datagrams == {14540: 1}


def test_idle_is_called_while_waiting(server):
    a = FakeParticipant(server, "/a")
    joined(server, a)
    calls = []

    def idle(timeout: float) -> None:
        if not calls:
            tick = a.tick()
            a.done(tick)
        calls.append(timeout)

    server.tick(0, {}, idle)
    assert calls
    assert all(0.0 <= timeout <= 0.1 for timeout in calls)


def test_connection_of_a_topic_declared_later_is_waited_for(server):
    a = FakeParticipant(server, "/a")
    b = FakeParticipant(server, "/b", subscriptions=[["/x", "T"]])
    joined(server, a, b)
    assert server.missing() == ""
    a.send_object(Kind.DECLARE, {"publications": [["/x", "T"]], "subscriptions": []})
    server.poll(PATIENCE)
    assert server.missing() == "1 connections are not made: /x from /a to /b"
    a.send_object(Kind.DECLARE, {"publications": [], "subscriptions": []})
    server.poll(PATIENCE)
    assert server.missing() == ""


class Link:
    """A host link with changes written by the test."""

    def __init__(self) -> None:
        self.name = "/simulator"
        self.news = [
            ({"publications": [["/models", "T"]]}, [], [], {}),
            (None, [[1, "/models", "/a", 1000, 0]], [], {}),
        ]
        self.reported: list[tuple[int, bool]] = []

    def collect(self):
        return self.news.pop(0) if self.news else (None, [], [], {})

    def counted(self, number, value):
        self.reported.append((number, value))


def test_the_simulators_own_messages_are_counted(server):
    link = Link()
    server.attach_host(link)
    a = FakeParticipant(server, "/a", subscriptions=[["/models", "T"]])
    joined(server, a)
    assert link.reported == [(1, True)]
    link.news.append((None, [], [], {1: 12}))
    with Running(server, 0):
        tick = a.tick()
        a.done(tick)
    assert list(tick.channels.values()) == [12]
    with pytest.raises(ValueError, match="attached already"):
        server.attach_host(link)


def test_a_topic_that_the_simulator_gives_up_is_not_waited_for(server):
    link = Link()
    server.attach_host(link)
    a = FakeParticipant(server, "/a", subscriptions=[["/models", "T"]])
    joined(server, a)
    link.news.append(({"publications": []}, [], [1], {}))
    with Running(server, 0):
        a.done(a.tick())
    assert server.missing() == ""


@pytest.mark.parametrize("joined_before", [False, True])
def test_connections_that_end_before_they_are_reported_leave_nothing(server, joined_before):
    """One report may have both ends of a short connection: a subscriber that comes and goes between two ticks."""
    link = Link()
    server.attach_host(link)
    subscriptions = [["/models", "T"]] if joined_before else []
    a = FakeParticipant(server, "/a", subscriptions=subscriptions)
    joined(server, a)
    for number in range(2, 100):
        subscriber = "/a" if number % 2 else f"/echo_{number}"
        link.news.append((None, [[number, "/models", subscriber, 1000, 0]], [number], {}))
    link.news.append((None, [], [1], {}))
    while link.news:
        server.poll(0.0)
    channels = server._channels
    assert not channels._live
    assert not channels._towards
    assert not channels._host_end.outgoing.channels
    assert not channels._host_end.outgoing.routes


def test_port_in_use_raises(server):
    with pytest.raises(OSError, match="in use"):
        LockstepServer(port=int(server.uri.rsplit(":", 1)[1]))
