"""The lockstep's protocol and server, with participants played over real sockets; no ROS."""

from __future__ import annotations

import logging
import os
import random
import socket
import struct
import subprocess
import sys
import threading
import time
import zlib
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from xtdrone_control.lockstep import protocol
from xtdrone_control.lockstep.protocol import FrameReader, Kind, ProtocolError, Schedule
from xtdrone_control.lockstep.server import LockstepServer

STEP = protocol.BASE_STEP_US


class FakeParticipant:
    """Speaks the protocol over a blocking socket."""

    def __init__(self, server: LockstepServer, name: str, rate: float = 30.0, **content) -> None:
        host, port = server.uri.removeprefix("tcp://").split(":")
        self.name = name
        self.sock = socket.create_connection((host, int(port)), timeout=5.0)
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
    server = LockstepServer(connect_limit=0.2, log=log)
    yield server
    server.close()


def joined(server: LockstepServer, *players: FakeParticipant) -> None:
    assert server.wait_for([player.name for player in players], timeout=5.0)
    for player in players:
        player.expect(Kind.WELCOME)


class Running:
    """One barrier in a thread of its own, so that the test can play the participants."""

    def __init__(self, server: LockstepServer, now_us: int, **options) -> None:
        self.thread = threading.Thread(target=server.tick, args=(now_us,), kwargs=options, daemon=True)

    def __enter__(self) -> Running:
        self.thread.start()
        return self

    def __exit__(self, *error) -> None:
        self.thread.join(10.0)
        assert not self.thread.is_alive(), "the barrier does not end"


# ---- protocol ----


def test_barrier_frames_survive_any_cutting():
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


def test_layout_is_as_documented():
    frame = protocol.pack_barrier(Kind.TICK, 3, 12000, {5: 6}, {14540: 9})
    assert frame == struct.pack("<IBQqIIIQIQ", 1 + 24 + 24, 7, 3, 12000, 1, 1, 5, 6, 14540, 9)


@pytest.mark.parametrize("data", [b"\0\0\0\0\1", b"\xff\xff\xff\xff\1"])
def test_bad_length_is_an_error(data):
    reader = FrameReader()
    reader.feed(data)
    with pytest.raises(ProtocolError, match="allowed"):
        list(reader.frames())


def test_bad_payloads_are_errors():
    whole = protocol.pack_barrier(Kind.TICK, 3, 12000, {5: 6}, {})[5:]
    for payload in (whole[:-1], whole + b"\0", b""):
        with pytest.raises(ProtocolError):
            protocol.unpack_barrier(payload)
    for payload in (b"", b"[1]", b"\xff"):
        with pytest.raises(ProtocolError):
            protocol.unpack_object(payload)


# ---- due times ----


def test_due_times_have_the_property_that_defines_them():
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
            # The next after any time up to just before it is it, and after it comes the next index.
            assert schedule.after_us(due - 1) == due
            assert schedule.after_us(due) == schedule.due_us(index + 1)


def test_thirty_hertz_is_thirty_in_every_second():
    schedule = Schedule(30.0)
    times, now = [], -1
    while (now := schedule.after_us(now)) < 10_000_000:
        times.append(now)
    assert len(times) == 300
    assert times[:5] == [0, 36000, 68000, 100000, 136000]


@pytest.mark.parametrize("rate", [0, -1.0, 250.1, float("nan"), float("inf"), "30", None])
def test_rate_out_of_range_is_refused(rate):
    with pytest.raises(ValueError, match="must be above 0 and at most 250 Hz"):
        Schedule(rate)


# ---- joining ----


def test_start_tells_who_is_missing(server):
    told = []
    assert not server.wait_for(["/a", "b"], timeout=0.0, progress=told.append)
    assert told == ["2 of 2 participants have not joined: /a, /b"]
    assert not server.wait_for(1, timeout=0.0, progress=told.append)
    assert told[-1] == "0 of 1 participants have joined"
    _a = FakeParticipant(server, "/a")
    assert server.wait_for(1, timeout=5.0)
    assert server.missing(["a"]) == ""


def test_start_waits_for_connections_between_declared_topics(server):
    a = FakeParticipant(server, "/a", publications=[["/x", "T"], ["/y", "T"]])
    b = FakeParticipant(server, "/b", subscriptions=[["/x", "T"]])
    told = []
    assert not server.wait_for(2, timeout=0.05, progress=told.append)
    assert told[-1] == "1 connections are not made: /x from /a to /b"
    a.expect(Kind.WELCOME)
    a.made(1, "/x", "/b")
    assert server.wait_for(2, timeout=5.0, progress=told.append)
    with Running(server, 0):
        b.expect(Kind.WELCOME)
        b.done(b.tick())
        a.done(a.tick())
    assert b.peers == [{"made": [[1, "/x", "/a", 1000]], "lost": [], "counted": [], "uncounted": []}]
    assert a.peers == [{"made": [], "lost": [], "counted": [1], "uncounted": []}]


def test_a_connection_that_is_never_made_is_given_up_with_a_warning(server, log):
    _a = FakeParticipant(server, "/a", publications=[["/x", "T"]])
    _b = FakeParticipant(server, "/b", subscriptions=[["/x", "T"]])
    assert server.wait_for(2, timeout=5.0)
    assert "no connection of /x from /a to /b within 0.2 s" in log.warnings()


def test_types_that_differ_are_named_and_not_waited_for(server, log):
    _a = FakeParticipant(server, "/a", publications=[["/x", "T"]])
    _b = FakeParticipant(server, "/b", subscriptions=[["/x", "U"]])
    assert server.wait_for(2, timeout=0.15)
    assert "/x: /a publishes T, /b subscribes to U" in log.warnings()


@pytest.mark.parametrize(
    ("change", "code", "text"),
    [
        ({"version": 99}, "version", "version 99"),
        ({"name": "b"}, "name", "must be a resolved ROS name"),
        ({"rate": 300}, "rate", "at most 250 Hz"),
        ({"name": "/a"}, "taken", "the name /a is taken by a participant connected from 127.0.0.1"),
    ],
)
def test_refusals_say_why(server, change, code, text):
    a = FakeParticipant(server, "/a")
    joined(server, a)
    content = {"name": "/b", "rate": 30.0, **change}
    b = FakeParticipant(server, content.pop("name"), content.pop("rate"), **content)
    server.poll(1.0)
    server.poll(0.0)
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
def test_garbage_ends_only_its_own_connection(server, log, garbage):
    a = FakeParticipant(server, "/a")
    joined(server, a)
    host, port = server.uri.removeprefix("tcp://").split(":")
    with socket.create_connection((host, int(port))) as sock:
        sock.sendall(garbage)
        end = time.monotonic() + 5.0
        while "no lockstep frame" not in log.warnings() and time.monotonic() < end:
            server.poll(0.1)
    assert "no lockstep frame" in log.warnings()
    with Running(server, 0):
        a.done(a.tick())
    assert list(server.participants) == ["/a"]


# ---- barrier ----


def test_each_is_called_at_its_own_rate(server):
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
        thread.join(5.0)
    for name, rate in rates.items():
        assert seen[name] == [Schedule(rate).due_us(index) for index in range(int(rate // 2))]


def test_without_participants_nothing_is_due(server):
    assert server.next_due_us(0) is None
    server.tick(0)


def test_counts_of_one_tick_come_with_the_next_and_only_when_changed(server):
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


def test_joining_late_holds_the_world_until_connected(log):
    server = LockstepServer(connect_limit=30.0, log=log)
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
        a.sock.settimeout(5.0)
        a.made(1, "/x", "/b")
        a.done(a.tick())
        late = b.tick()
        b.done(late)
    assert late.time_us == 36000
    assert server.next_due_us(36000) == 40000
    server.close()


def test_a_closed_connection_is_dropped_at_once_and_the_others_go_on(server, log):
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


def test_taking_leave_is_no_warning(server, log):
    a = FakeParticipant(server, "/a")
    joined(server, a)
    a.send_object(Kind.LEAVE, {"reason": "shut down"})
    server.poll(1.0)
    assert not server.participants
    assert log.warnings() == ""


def test_a_silent_participant_is_dropped_after_the_hang_limit(log):
    server = LockstepServer(hang_limit=0.3, log=log)
    a, b = FakeParticipant(server, "/a"), FakeParticipant(server, "/b")
    joined(server, a, b)
    with Running(server, 0):
        a.done(a.tick())
        b.tick()
    assert list(server.participants) == ["/a"]
    assert "/b was silent for" in log.warnings()
    assert "silent" in b.expect(Kind.REFUSED)["reason"]
    server.close()


def test_keep_alives_hold_off_the_hang_limit_but_not_the_busy_limit(log):
    server = LockstepServer(hang_limit=0.2, busy_limit=0.8, log=log)
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
    assert time.monotonic() - started > 0.75
    assert "/a took more than 0.8 s for one tick" in log.warnings()
    server.close()


def own(pid: int) -> dict:
    """How a participant names a process of this machine."""
    return {"pid": pid, "host": protocol.process_namespace()}


def test_who_waits_for_time_to_go_on_says_so_while_the_barrier_waits(server):
    a, b = FakeParticipant(server, "/a"), FakeParticipant(server, "/b")
    joined(server, a, b)
    assert not server.needs_time
    seen = []
    with Running(server, 10 * STEP, idle=lambda timeout: seen.append(server.needs_time) or time.sleep(0.001)):
        tick = a.tick()
        b.done(b.tick())
        for frame, needs in ((protocol.NEEDS_TIME_FRAME, True), (protocol.ALIVE_FRAME, False)):
            a.sock.sendall(frame)
            end = time.monotonic() + 5.0
            while not seen or seen[-1] is not needs:
                assert time.monotonic() < end, seen
        a.sock.sendall(protocol.NEEDS_TIME_FRAME)
        a.done(tick)
    assert server.needs_time
    a.sock.close()
    server.poll(0.1)
    assert not server.needs_time


def test_a_dead_process_is_noticed_though_another_holds_its_connection(log):
    server = LockstepServer(hang_limit=60.0, log=log)
    process = subprocess.Popen(["sleep", "60"])
    a, b = FakeParticipant(server, "/a"), FakeParticipant(server, "/b", **own(process.pid))
    joined(server, a, b)
    with Running(server, 0):
        a.done(a.tick())
        b.tick()
        killed = time.monotonic()
        process.kill()
        process.wait()
    assert time.monotonic() - killed < 10.0  # about SILENCE; the hang limit is far
    assert f"/b is gone: its process {process.pid} has ended" in log.warnings()
    assert list(server.participants) == ["/a"]
    server.close()


def test_a_zombie_counts_as_dead(log):
    server = LockstepServer(hang_limit=60.0, log=log)
    process = subprocess.Popen(["sleep", "60"])
    b = FakeParticipant(server, "/b", **own(process.pid))
    joined(server, b)
    with Running(server, 0):
        b.tick()
        process.kill()  # and nobody asks for its status
    assert not server.participants
    process.wait()
    server.close()


def test_a_process_that_a_debugger_has_stopped_does_not_hang(log):
    """A debugger such as gdb stops every thread, the one that sends keep-alives too."""
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


def test_a_process_of_another_machine_is_not_looked_for(log):
    server = LockstepServer(hang_limit=0.3, log=log)
    b = FakeParticipant(server, "/b", pid=1, host="another boot, another namespace")
    joined(server, b)
    with Running(server, 0):
        b.tick()
    assert "silent" in log.warnings()
    server.close()


class Reserving(FakeParticipant):
    """Reserves its name first."""

    def __init__(self, server: LockstepServer, name: str) -> None:
        host, port = server.uri.removeprefix("tcp://").split(":")
        self.name = name
        self.sock = socket.create_connection((host, int(port)), timeout=5.0)
        self.reader = FrameReader()
        self.frames = []
        self.peers = []
        self.send_object(Kind.RESERVE, {"version": protocol.VERSION, "name": name})


def test_a_reserved_name_is_taken_until_its_owner_joins_or_goes(server, log):
    first, second = Reserving(server, "/a"), Reserving(server, "/a")
    server.poll(1.0)
    server.poll(1.0)
    first.expect(Kind.WELCOME)
    assert second.expect(Kind.REFUSED)["code"] == "taken"
    assert not server.participants, "a reservation is no participant"
    intruder = FakeParticipant(server, "/a")
    server.poll(1.0)
    assert intruder.expect(Kind.REFUSED)["code"] == "taken"
    first.send_object(Kind.JOIN, {"version": protocol.VERSION, "name": "/a", "rate": 30.0})
    joined(server, first)
    late = Reserving(server, "/a")
    server.poll(1.0)
    assert late.expect(Kind.REFUSED)["code"] == "taken"
    first.sock.close()
    server.poll(1.0)
    again = Reserving(server, "/a")
    server.poll(1.0)
    again.expect(Kind.WELCOME)
    again.sock.close()
    server.poll(1.0)
    joined(server, FakeParticipant(server, "/a"))


def test_digests_are_asked_for_and_passed_on(log):
    got = []
    server = LockstepServer(log=log, on_digest=lambda *content: got.append(content))
    a = FakeParticipant(server, "/a")
    assert server.wait_for(["/a"], timeout=5.0)
    assert a.expect(Kind.WELCOME)["digest"] is True
    a.send_object(Kind.DIGEST, {"time_us": 1_000_000, "topics": {"/x": [3, 40, 0xFFFFFFFF]}})
    server.poll(1.0)
    assert got == [("/a", 1_000_000, {"/x": [3, 40, 0xFFFFFFFF]})]
    server.close()


@given(st.lists(st.tuples(st.integers(0, 2**60), st.binary(max_size=50)), max_size=20))
def test_a_digest_is_the_checksum_of_all_in_one_piece(messages):
    digest, whole = protocol.Digest(), b""
    for time_us, message in messages:
        digest.add(time_us, message)
        whole += struct.pack("<qI", time_us, len(message)) + message
    assert digest.state() == [len(messages), sum(len(m) for _, m in messages), zlib.crc32(whole)]


def test_datagrams_are_counted_both_ways(server):
    a = FakeParticipant(server, "/a", udp_ports=[14540, 14541])
    b = FakeParticipant(server, "/b")
    joined(server, a, b)
    with Running(server, 0, datagrams={14540: 2, 9: 9}):
        first = a.tick()
        a.done(first, datagrams={14580: 5})
        b.done(b.tick(), datagrams={14580: 1, 14581: 4})
    assert first.datagrams == {14540: 2}
    assert server.datagrams_expected == {14580: 6, 14581: 4}
    with Running(server, 36000, datagrams={14540: 2, 14541: 1}):
        second = a.tick()
        a.done(second, datagrams={14580: 7})
        b.sock.close()
    assert second.datagrams == {14541: 1}
    assert server.datagrams_expected == {14580: 8, 14581: 4}
    # One that comes later was not there to receive what was sent before.
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


def test_a_topic_declared_later_is_waited_for(server):
    a = FakeParticipant(server, "/a")
    b = FakeParticipant(server, "/b", subscriptions=[["/x", "T"]])
    joined(server, a, b)
    assert server.missing() == ""
    a.send_object(Kind.DECLARE, {"publications": [["/x", "T"]], "subscriptions": []})
    server.poll(1.0)
    assert server.missing() == "1 connections are not made: /x from /a to /b"
    a.send_object(Kind.DECLARE, {"publications": [], "subscriptions": []})
    server.poll(1.0)
    assert server.missing() == ""


class Link:
    """A host whose news the test writes."""

    def __init__(self) -> None:
        self.name = "/simulator"
        self.news = [
            ({"publications": [["/models", "T"]]}, [], [], {}),
            (None, [[1, "/models", "/a", 1000, 0]], [], {}),
        ]
        self.told: list[tuple[int, bool]] = []

    def collect(self):
        return self.news.pop(0) if self.news else (None, [], [], {})

    def counted(self, number, value):
        self.told.append((number, value))


def test_the_simulators_own_messages_are_counted(server):
    link = Link()
    server.attach_host(link)
    a = FakeParticipant(server, "/a", subscriptions=[["/models", "T"]])
    joined(server, a)
    assert link.told == [(1, True)]
    link.news.append((None, [], [], {1: 12}))
    with Running(server, 0):
        tick = a.tick()
        a.done(tick)
    assert list(tick.channels.values()) == [12]
    with pytest.raises(ValueError, match="attached already"):
        server.attach_host(link)


def test_a_port_in_use_is_an_error(server):
    with pytest.raises(OSError, match="in use"):
        LockstepServer(port=int(server.uri.rsplit(":", 1)[1]))
