"""The lockstep on one machine: Unix domain sockets beside TCP, and the inner loops in C++; no ROS master."""

from __future__ import annotations

import gc
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_lockstep_server import PATIENCE, STEP, FakeParticipant, Log, Running, joined, poll_until
from xtdrone_native import lockstep_io

from xtdrone_lockstep import protocol, unix_sockets
from xtdrone_lockstep.protocol import Kind
from xtdrone_lockstep.server import LockstepServer

U32 = st.integers(0, (1 << 32) - 1)
U64 = st.integers(0, (1 << 64) - 1)
PAIRS = st.dictionaries(U32, U64, max_size=80)


@pytest.fixture
def log() -> Log:
    return Log()


@pytest.fixture
def server(log):
    server = LockstepServer(connect_limit=PATIENCE, log=log)
    yield server
    server.close()


class Neighbour(FakeParticipant):
    """A participant over the Unix domain socket."""

    def __init__(self, server: LockstepServer, name: str, rate: float = 250.0, **content) -> None:
        super().__init__(server, name, rate, **content)

    def send_object(self, kind: Kind, content: dict) -> None:
        if kind == Kind.JOIN:
            host, port = self.sock.getpeername()
            self.sock.close()
            sock = unix_sockets.connect(unix_sockets.SERVER, host, port, PATIENCE)
            assert sock is not None
            self.sock = sock
        super().send_object(kind, content)


@pytest.fixture(params=[FakeParticipant, Neighbour], ids=["tcp", "unix"])
def participant(request):
    """Create participants of one transport."""
    return lambda server, name, **content: request.param(server, name, rate=250.0, **content)


# ---- frames ----


@given(st.sampled_from([Kind.TICK, Kind.DONE]), U64, st.integers(-(1 << 63), (1 << 63) - 1), PAIRS, PAIRS)
def test_barrier_frames_follow_their_description(kind, tick, time_us, channels, datagrams):
    flat = [number for pairs in (channels, datagrams) for pair in pairs.items() for number in pair]
    payload = struct.pack("<QqII" + "IQ" * (len(flat) // 2), tick, time_us, len(channels), len(datagrams), *flat)
    frame = protocol.pack_barrier(kind, tick, time_us, channels, datagrams)
    assert frame == struct.pack("<IB", 1 + len(payload), kind) + payload
    assert protocol.unpack_barrier(payload) == (tick, time_us, channels, datagrams)


@pytest.mark.parametrize(("kind", "channels"), [(Kind.LEAVE, {}), (Kind.DONE, {1 << 32: 1}), (Kind.DONE, {1: 1 << 64})])
def test_numbers_out_of_range_are_not_packed(kind, channels):
    with pytest.raises((ValueError, OverflowError)):
        protocol.pack_barrier(kind, 1, 0, channels, {})


@given(st.lists(st.binary(max_size=300), max_size=20), st.lists(st.integers(1, 400), min_size=1), st.binary(max_size=3))
def test_messages_are_the_same_for_any_cuts(messages, sizes, tail):
    data = b"".join(struct.pack("<I", len(message)) + message for message in messages) + tail
    splitter, found, at = lockstep_io.Splitter(), [], 0
    for turn in range(len(data)):
        size = sizes[turn % len(sizes)]
        found += splitter.cut(data[at : at + size])
        at += size
    assert found == messages


def test_length_beyond_all_data_is_awaited_without_memory():
    splitter = lockstep_io.Splitter()
    sender, receiver = socket.socketpair()
    with sender, receiver:
        sender.sendall(b"\xff\xff\xff\xffabc")
        assert splitter.read(receiver, 4096) == ([], 7)
        assert splitter.read(receiver, 4096) is None
    with pytest.raises(ValueError, match="negative"):
        splitter.read(receiver, 4096)


# ---- joining ----


def test_neighbours_and_participants_over_tcp_take_the_same_turns(server):
    near, far = Neighbour(server, "/near"), FakeParticipant(server, "/far", rate=250.0)
    joined(server, near, far)
    near.made(1, "/t", "/far")
    poll_until(server, lambda: server.participants["/near"].outgoing.channels)
    for number in range(1, 4):
        with Running(server, STEP * number):
            ticks = [one.tick() for one in (near, far)]
            near.done(ticks[0], {1: 10 * number})
            far.done(ticks[1])
        assert [tick.tick for tick in ticks] == [number, number]
        assert list(ticks[1].channels.values()) == ([10 * (number - 1)] if number > 1 else [])


def test_other_users_are_neither_accepted_nor_trusted(server, monkeypatch):
    host, port = server.uri.removeprefix("tcp://").split(":")
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    assert unix_sockets.connect(unix_sockets.SERVER, host, int(port), PATIENCE) is None
    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.settimeout(PATIENCE)
        stranger.connect(f"\0xtdrone-server/{host}:{port}")
        while not select.select([stranger], [], [], 0.0)[0]:
            server.poll(0.05)
        assert stranger.recv(1) == b""


def test_without_the_socket_or_on_another_machine_there_is_no_connection(server):
    port = int(server.uri.rpartition(":")[2])
    assert unix_sockets.connect(unix_sockets.TOPICS, "127.0.0.1", port, PATIENCE) is None
    assert unix_sockets.connect(unix_sockets.SERVER, "192.0.2.1", port, PATIENCE) is None
    assert unix_sockets.connect(unix_sockets.SERVER, "no host", port, PATIENCE) is None


@pytest.mark.parametrize("size", [1, 7, 29, 1000])
def test_done_may_arrive_in_any_pieces(server, participant, size):
    a, b = participant(server, "/a"), participant(server, "/b")
    joined(server, a, b)
    a.made(1, "/t", "/b")
    poll_until(server, lambda: server.participants["/a"].outgoing.channels)
    for number in range(1, 4):
        with Running(server, STEP * number):
            tick = a.tick()
            frames = protocol.ALIVE_FRAME + protocol.pack_barrier(Kind.DONE, tick.tick, 0, {1: number}, {})
            for at in range(0, len(frames), size):
                a.sock.sendall(frames[at : at + size])
            b.done(b.tick())
        assert not server.participants["/a"].waiting
        assert list(server.participants["/b"].news.counts.values()) == [number]


def test_done_of_another_tick_is_ignored_and_a_second_one_changes_nothing(server, participant):
    a = participant(server, "/a")
    joined(server, a)
    for number in range(1, 4):
        with Running(server, STEP * number) as running:
            tick = a.tick()
            for other in (0, tick.tick - 1, tick.tick + 1, (1 << 64) - 1):
                a.sock.sendall(protocol.pack_barrier(Kind.DONE, other, 0, {}, {}))
            assert running.thread.is_alive()
            a.done(tick)
        a.done(tick)
    server.poll(0.0)
    assert "/a" in server.participants


@pytest.mark.parametrize(
    "payload", [b"", bytes(23), struct.pack("<QqII", 1, 0, 1, 0), struct.pack("<QqII", 1, 0, 0xFFFFFFFF, 0xFFFFFFFF)]
)
def test_malformed_done_closes_its_connection_only(server, participant, log, payload):
    a, b = participant(server, "/a"), participant(server, "/b")
    joined(server, a, b)
    with Running(server, STEP):
        a.tick()
        a.sock.sendall(struct.pack("<IB", 1 + len(payload), Kind.DONE) + payload)
        b.done(b.tick())
    assert set(server.participants) == {"/b"}
    assert "sent an invalid lockstep frame" in log.warnings()


def test_flood_of_one_participant_does_not_stop_the_others(server, participant):
    a, b = participant(server, "/a"), participant(server, "/b")
    joined(server, a, b)
    flood = (protocol.ALIVE_FRAME + protocol.pack_barrier(Kind.DONE, 0, 0, {7: 7}, {})) * 3000
    for number in range(1, 4):
        with Running(server, STEP * number):
            tick = a.tick()
            b.done(b.tick())
            a.sock.sendall(flood)
            a.done(tick)
    assert set(server.participants) == {"/a", "/b"}


def test_participant_that_ends_within_a_frame_is_dropped(server, participant, log):
    a, b = participant(server, "/a"), participant(server, "/b")
    joined(server, a, b)
    with Running(server, STEP):
        tick = a.tick()
        a.sock.sendall(protocol.pack_barrier(Kind.DONE, tick.tick, 0, {1: 1}, {})[:-1])
        a.sock.close()
        b.done(b.tick())
    assert set(server.participants) == {"/b"}
    assert "is gone" in log.warnings()


def test_participants_in_time_need_no_idle_call_unless_they_need_time(server, participant):
    a = participant(server, "/a")
    joined(server, a)
    calls: list[float] = []

    def idle(timeout: float) -> None:
        calls.append(timeout)
        select.select([server.fileno()], [], [], timeout)

    with Running(server, STEP, idle=idle, head_start=PATIENCE):
        a.done(a.tick())
    assert not calls
    a.sock.sendall(protocol.NEEDS_TIME_FRAME)
    poll_until(server, lambda: server.needs_time)
    with Running(server, 2 * STEP, idle=idle, head_start=PATIENCE):
        a.done(a.tick())
    assert calls


STOPPED = """
import os, signal, sys
from xtdrone_lockstep import unix_sockets, protocol
sock = unix_sockets.connect(unix_sockets.SERVER, "127.0.0.1", int(sys.argv[1]), 60.0)
content = {"version": protocol.VERSION, "name": "/stopped", "rate": 250.0}
sock.sendall(protocol.pack_object(protocol.Kind.JOIN, content))
os.kill(os.getpid(), signal.SIGSTOP)
"""


def test_stopped_process_is_dropped_after_the_hang_limit(log):
    server = LockstepServer(connect_limit=PATIENCE, hang_limit=0.5, log=log)
    program = [sys.executable, "-c", STOPPED, server.uri.rpartition(":")[2]]
    with subprocess.Popen(program) as process:
        try:
            a = Neighbour(server, "/a")
            assert server.wait_for(["/a", "/stopped"], timeout=PATIENCE)
            a.expect(Kind.WELCOME)
            for number in range(1, 3):
                with Running(server, STEP * number):
                    a.done(a.tick())
            assert set(server.participants) == {"/a"}
            assert "/stopped was silent" in log.warnings()
        finally:
            process.kill()
            server.close()


def test_participant_that_does_not_read_gets_everything_later(server, participant):
    a, b = participant(server, "/a"), participant(server, "/b")
    joined(server, a, b)
    a.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    server.participants["/a"].connection.sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
    rows = [[number, "/x", "/a", 1000, 1] for number in range(1, 1001)]
    b.send_object(Kind.PEER, {"made": rows, "lost": []})
    poll_until(server, lambda: len(server.participants["/b"].outgoing.channels) == len(rows))
    for number in range(1, 4):
        with Running(server, STEP * number):
            b.done(b.tick(), {row[0]: number + 1 for row in rows})
            a.done(a.tick())
    assert sum(len(peers["made"]) for peers in a.peers) == len(rows)


# ---- waiting ----


class InterruptedWaitError(Exception):
    """Raised by a signal handler."""


def test_signal_ends_a_wait():
    def interrupt(*_: object) -> None:
        raise InterruptedWaitError

    sender, receiver = socket.socketpair()
    previous = signal.signal(signal.SIGALRM, interrupt)
    try:
        with sender, receiver, select.epoll() as epoll:
            epoll.register(receiver.fileno(), select.EPOLLIN)
            for wait in (
                lambda: lockstep_io.receive(epoll.fileno(), receiver.fileno(), PATIENCE, True),
                lambda: lockstep_io.Exchange(epoll.fileno()).poll(PATIENCE),
            ):
                signal.setitimer(signal.ITIMER_REAL, 0.01, 0.01)
                with pytest.raises(InterruptedWaitError):
                    wait()
                signal.setitimer(signal.ITIMER_REAL, 0.0)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)


def test_turns_of_a_closed_connection_are_forgotten_after_a_signal():
    def interrupt(*_: object) -> None:
        raise InterruptedWaitError

    (sender, done), (other, late) = socket.socketpair(), socket.socketpair()
    previous = signal.signal(signal.SIGALRM, interrupt)
    with sender, done, other, late, select.epoll() as epoll:
        exchange = lockstep_io.Exchange(epoll.fileno())
        for receiver in (done, late):
            epoll.register(receiver.fileno(), select.EPOLLIN)
            exchange.add(receiver.fileno(), {}, [])
            exchange.expect(receiver.fileno(), 1)
        sender.sendall(protocol.pack_barrier(Kind.DONE, 1, 0, {}, {}))
        signal.setitimer(signal.ITIMER_REAL, 0.05, 0.05)
        try:
            with pytest.raises(InterruptedWaitError):
                exchange.poll(PATIENCE)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, previous)
        exchange.remove(done.fileno())
        other.sendall(protocol.pack_barrier(Kind.DONE, 1, 0, {}, {}))
        assert exchange.poll(PATIENCE) == ([(late.fileno(), None)], [])


class Garbage:
    """Calls a function when Python's garbage collector finds it."""

    def __init__(self, function: Callable[[], object]) -> None:
        self.function = function
        self.own = self

    def __del__(self) -> None:
        self.function()


def test_reads_inside_a_collection_of_garbage_leave_a_message_intact():
    message = struct.pack("<I", 5) + b"first"
    (sender, receiver), (other, late) = socket.socketpair(), socket.socketpair()
    splitters = lockstep_io.Splitter(), lockstep_io.Splitter()
    with sender, receiver, other, late:
        sender.sendall(message)
        other.sendall(b"x" * 100)
        lists = [[] for _ in range(200)]  # the next one is newly allocated
        gc.collect()
        limits = gc.get_threshold()
        gc.disable()
        Garbage(lambda: splitters[1].read(late, 4096))
        gc.set_threshold(1)
        gc.enable()
        try:
            messages = splitters[0].read(receiver, 4096)[0]
        finally:
            gc.set_threshold(*limits)
        assert messages == [b"first"]
        assert len(lists) == 200
        assert splitters[1].read(late, 4096) is None  # the collection has read from it


def test_receive_returns_a_tick_only_if_it_is_alone():
    tick = protocol.pack_barrier(Kind.TICK, 3, -5, {1: 2}, {14540: 7})
    content = (3, -5, {1: 2}, {14540: 7})
    peer = protocol.pack_object(Kind.PEER, {})
    sender, receiver = socket.socketpair()
    with sender, receiver, select.epoll() as epoll:
        epoll.register(receiver.fileno(), select.EPOLLIN)

        def receive(whole: bool = True):
            return lockstep_io.receive(epoll.fileno(), receiver.fileno(), 0.0, whole)

        assert receive() == []
        for data, whole, expected in (
            (tick, True, content),
            (tick, False, tick),
            (peer + tick, True, peer + tick),
            (tick + b"x", True, tick + b"x"),
            (tick[:-1], True, tick[:-1]),
            (tick[:4] + b"\x08" + tick[5:], True, tick[:4] + b"\x08" + tick[5:]),
        ):
            sender.sendall(data)
            assert receive(whole) == expected
        sender.close()
        assert receive() == b""


# ---- topic connections ----


@pytest.fixture
def accepted(monkeypatch):
    """Serve topic connections without rospy; yield the port and the accepted connections."""
    rospy = pytest.importorskip("rospy")
    from xtdrone_lockstep.transport import local_topics

    hooks, made, arrived = [], [], threading.Semaphore(0)

    def accept(sock: socket.socket, address: tuple[str, int]) -> None:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        made.append((sock, address))
        arrived.release()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        monkeypatch.setattr(local_topics, "topic_server_address", lambda: ("127.0.0.1", port))
        monkeypatch.setattr(local_topics, "accept_topic_connection", accept)
        monkeypatch.setattr(rospy.core, "add_shutdown_hook", hooks.append)
        local_topics.serve()
        yield port, made, arrived
    for hook in hooks:
        hook("")
    for sock, _ in made:
        sock.close()


def test_topic_connections_carry_the_number_of_the_subscriber(accepted):
    port, made, arrived = accepted
    for address in (
        "",
        "\0xtdrone-subscriber/x/0",
        "\0xtdrone-subscriber/x/65536",
        "\0xtdrone-subscriber/x/-1",
        "\0y/1",
    ):
        stranger = unix_sockets.connect(unix_sockets.TOPICS, "127.0.0.1", port, PATIENCE, address)
        assert stranger is not None
        with stranger:
            assert stranger.recv(1) == b"", "it is closed"
    subscriber = unix_sockets.connect(unix_sockets.TOPICS, "127.0.0.1", port, PATIENCE, "\0xtdrone-subscriber/x/65535")
    assert subscriber is not None
    with subscriber:
        assert arrived.acquire(timeout=PATIENCE)
        assert [address for _, address in made] == [("127.0.0.1", 65535)]
