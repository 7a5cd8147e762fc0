"""The lockstep with a real ROS master and real nodes, one process each; this test plays the simulator.

Run as a program, this file is one of these nodes.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from ros_master import RosMaster

import xtdrone_lockstep as lockstep
from xtdrone_lockstep.protocol import Schedule
from xtdrone_lockstep.server import LockstepServer

try:
    import rosgraph
    import rospy
    from geometry_msgs.msg import PointStamped
    from rosgraph_msgs.msg import Clock
    from std_msgs.msg import String
    from std_srvs.srv import Empty, EmptyResponse
except ImportError:
    rospy = None

pytestmark = pytest.mark.skipif(rospy is None, reason="needs ROS 1: rosmaster and rospy (apt install ros-core)")

RATES = {"/a": 50.0, "/b": 30.0, "/c": 20.0}
END_US = 1_500_000
PATIENCE = 120.0  # s of wall time; a starved machine takes half a minute to start a node


# ---- the nodes ----


def participant(name: str, seed: int, peers: list[str]) -> None:
    """Publish a checksum of all received messages on two topics, and record the messages with their times.

    One topic is its own, the other is shared by all nodes.
    """
    lockstep.init_node(name, rate=RATES["/" + name])
    lazy = random.Random(seed)
    digest = hashlib.sha256(name.encode())
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process

    def take(message: String, source: str) -> None:
        digest.update(message.data.encode())
        print(rospy.Time.now().to_nsec() // 1000, source, message.data, file=out)

    publishers = [lockstep.Publisher(f"/from_{name}", String), lockstep.Publisher("/shared", String)]
    keep = [lockstep.Subscriber(f"/from_{peer}", String, take, peer) for peer in peers]
    keep.append(lockstep.Subscriber("/shared", String, take, "shared"))
    keep.append(lockstep.Subscriber("/foreign", String, take, "foreign"))
    assert rospy.Time.now().to_nsec() == 0
    lockstep.start()
    assert lockstep.is_active()

    def step() -> None:
        if seed:
            time.sleep(lazy.choice([0.0, 0.0, 0.0, 0.02]))
        now = rospy.Time.now().to_nsec() // 1000
        for publisher in publishers:
            publisher.publish(f"{now} {name} {digest.hexdigest()[:16]}")

    lockstep.spin(step)


def alone(name: str) -> None:
    """Run three turns of wall time without a simulator."""
    lockstep.init_node(name, rate=50.0)
    main, seen = threading.get_ident(), []

    def take(message: String) -> None:
        seen.append((message.data, threading.get_ident()))

    def registered() -> list[bool]:
        return [
            any(given == wanted for given, _ in part)
            for part, wanted in zip(rosgraph.Master(name).getSystemState(), ("/loop", "/loop", "/help"), strict=True)
        ]

    with lockstep.registering_together():
        publisher = lockstep.Publisher("/loop", String, latch=True)
        _subscriber = lockstep.Subscriber("/loop", String, take)
        _service = rospy.Service("/help", Empty, lambda _: EmptyResponse())
        assert registered() == [False] * 3
    assert registered() == [True] * 3
    lockstep.start()
    assert not lockstep.is_active()
    assert rospy.Time.now().to_sec() > 1e9
    publisher.publish("hello")
    rate = lockstep.Rate(50.0)
    while not seen:
        rate.sleep()
    assert seen == [("hello", main)]
    print("alone is well")


def on_clock(name: str) -> None:
    """Run ten turns of simulated time without lockstep; time advances with each message."""
    lockstep.init_node(name, rate=50.0)
    served: list[tuple[object, float]] = []

    def serve(expected, timeout: float):
        served.append((expected, timeout))
        return {}

    lockstep.declare_udp([1], serve)
    clock = lockstep.UncountedPublisher("/clock", Clock)
    over = threading.Event()

    def run_clock() -> None:
        for step in itertools.count(1):
            if over.wait(0.001):
                return
            clock.publish(Clock(rospy.Time.from_sec(step * 0.004)))

    lockstep.start()
    assert not lockstep.is_active()
    thread = threading.Thread(target=run_clock)
    thread.start()
    began = rospy.get_time()
    rate = lockstep.Rate()
    for _ in range(10):
        rate.sleep()
    ended = rospy.get_time()
    over.set()
    thread.join()
    assert served == [(None, 0.0)] * 10
    assert ended - began > 10 / 50.0 - 1e-6
    print("on the clock")


def talker(name: str) -> None:
    """Latch one message; a node outside the lockstep."""
    rospy.init_node(name)
    publisher = rospy.Publisher("/foreign", String, latch=True, queue_size=1)
    publisher.publish("hello")
    rospy.spin()


def listener(name: str) -> None:
    """Subscribe; a node outside the lockstep."""
    rospy.init_node(name)
    _subscriber = rospy.Subscriber("/flood", String, lambda message: None)
    rospy.spin()


def flood(name: str) -> None:
    """Publish messages larger than socket buffers."""
    lockstep.init_node(name, rate=50.0)
    publisher = lockstep.Publisher("/flood", String, queue_size=5)
    lockstep.start()
    message = String("x" * 500_000)
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process

    def step() -> None:
        print(publisher.get_num_connections(), file=out)
        publisher.publish(message)

    lockstep.spin(step)


def heavy(name: str) -> None:
    """Publish messages larger than socket buffers, and record the lengths of those of another such node."""
    lockstep.init_node(name, rate=50.0)
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process

    def take(message: String) -> None:
        print(rospy.Time.now().to_nsec() // 1000, message.data[:3], len(message.data), file=out)

    publisher = lockstep.Publisher(f"/from_{name}", String)
    _subscriber = lockstep.Subscriber("/from_b" if name == "a" else "/from_a", String, take)
    lockstep.start()
    turns = itertools.count()

    def step() -> None:
        turn = next(turns)
        for _ in range(3):
            publisher.publish(f"{turn:03d}" + "x" * (2_000_000 + turn))

    lockstep.spin(step)


def churner(name: str) -> None:
    """Subscribe, unregister and subscribe again while another node publishes; record the number of publishers."""
    lockstep.init_node(name, rate=50.0)
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process
    current: list[lockstep.Subscriber] = []
    lockstep.start()
    for turn in range(20):
        if turn % 4 == 0:
            current.append(
                lockstep.Subscriber("/from_a", String, lambda message, t=turn: print(t, message.data, file=out))
            )
        elif turn % 4 == 3:
            print(turn, "connections", current[-1].get_num_connections(), file=out)
            current.pop().unregister()
        lockstep.Rate().sleep()
    lockstep.spin()


def sleeper(name: str) -> None:
    """Receive own messages, unregister a second subscriber in the first one's callback, and sleep for a second."""
    lockstep.init_node(name, rate=50.0)
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process
    late: list[lockstep.Subscriber] = []

    def take(_: String) -> None:
        print("heard", file=out)
        late.pop().unregister()

    publisher = lockstep.Publisher("/x", String)
    first = lockstep.Subscriber("/x", String, take)
    late.append(lockstep.Subscriber("/y", String))
    lockstep.start()
    publisher.publish("hello")
    lockstep.sleep(1.0)
    print("slept until", rospy.Time.now().to_nsec() // 1000, file=out)
    first.unregister()
    lockstep.spin()


def mixer(name: str) -> None:
    """Join the lockstep, and subscribe to the same node with a plain rospy subscriber, as a tf listener does."""
    lockstep.init_node(name, rate=50.0)
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process
    _plain = rospy.Subscriber("/from_a", String, lambda message: print("plain", file=out))
    _counted = lockstep.Subscriber("/shared", String, lambda message: print("counted", file=out))
    lockstep.start()
    lockstep.spin()


def crasher(name: str) -> None:
    """Raise an exception in the third turn."""
    lockstep.init_node(name, rate=50.0)
    lockstep.start()
    rate = lockstep.Rate()
    for turns_left in (2, 1, 0):
        print(1 // turns_left)
        rate.sleep()


def stamper(name: str) -> None:
    """Publish a latched message with a header in each fifth turn."""
    lockstep.init_node(name, rate=50.0)
    publisher = lockstep.Publisher("/stamped", PointStamped, latch=True)
    lockstep.start()
    turns = itertools.count()
    lockstep.spin(lambda: publisher.publish(PointStamped()) if next(turns) % 5 == 0 else None)


def reader_of_stamps(name: str) -> None:
    """Record sequence numbers."""
    lockstep.init_node(name, rate=50.0)
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process
    _subscriber = lockstep.Subscriber("/stamped", PointStamped, lambda message: print(message.header.seq, file=out))
    lockstep.start()
    lockstep.spin()


def late_rider(name: str) -> None:
    """Report the latched message; a node outside the lockstep."""
    rospy.init_node(name)
    rospy.wait_for_message("/stamped", PointStamped)
    print("got it", flush=True)


def thinker(name: str) -> None:
    """Wait, within a turn, for the end of standard input, like a node at a breakpoint."""
    lockstep.init_node(name, rate=50.0)
    lockstep.start()
    print("stands", flush=True)
    sys.stdin.read()
    lockstep.spin()


def parent(name: str) -> None:
    """Start an idle child process that holds all connections open."""
    lockstep.init_node(name, rate=50.0)
    lockstep.start()
    lockstep.Rate().sleep()
    child = os.fork()
    if child == 0:
        signal.pause()
    print("child", child, flush=True)
    signal.pause()  # in its turn


def traveller(name: str) -> None:
    """Record resets of time."""
    lockstep.init_node(name, rate=50.0)
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process
    lockstep.add_reset_hook(lambda: print("back", rospy.Time.now().to_nsec() // 1000, file=out))
    lockstep.start()
    lockstep.spin(lambda: print("turn", rospy.Time.now().to_nsec() // 1000, file=out))


def simulator(name: str) -> None:
    """Play a simulator that publishes a message before each tick, to be delivered in that tick."""
    rospy.init_node(name)
    server = LockstepServer(hang_limit=PATIENCE, connect_limit=PATIENCE)
    publisher = lockstep.Publisher("/from_simulator", String)
    server.attach_host(lockstep.host())
    rospy.set_param("/lockstep/uri", server.uri)
    assert server.wait_for(["/a"], timeout=PATIENCE)
    now: int | None = 0
    while now is not None and now < 300_000:
        publisher.publish(f"{now}")
        server.tick(now)
        now = server.next_due_us(now)
    server.close()


def hearing_simulator(name: str, end_us: str, back_us: str) -> None:
    """Play a simulator that subscribes: record the messages dispatched after each tick; optionally reset time once."""
    rospy.init_node(name)
    server = LockstepServer(hang_limit=PATIENCE, connect_limit=PATIENCE)
    link = lockstep.host()
    server.attach_host(link)
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process
    now: int | None = 0

    def take(message: String, source: str) -> None:
        assert threading.current_thread() is threading.main_thread()
        print(now, source, message.data, file=out)

    heard = ["b", "a", "c"]
    keep = [lockstep.Subscriber(f"/from_{source}", String, take, source) for source in heard]
    keep += [lockstep.Subscriber("/shared", String, take, "shared"), lockstep.Subscriber("/foreign", String, take, "f")]
    rospy.set_param("/lockstep/uri", server.uri)
    assert server.wait_for(list(RATES), timeout=PATIENCE), server.missing(list(RATES))
    back = int(back_us)
    while now is not None and now < int(end_us):
        server.tick(now)
        link.receive()
        if back and now >= back:
            print(now, "back", file=out)
            server.reset_time(0)
            now, back = server.next_due_us(-1), 0
        else:
            now = server.next_due_us(now)
    server.close()


def announcer(name: str) -> None:
    """Play a simulator that publishes uncounted messages, until a signal ends it."""
    rospy.init_node(name)
    server = LockstepServer(hang_limit=PATIENCE, connect_limit=PATIENCE)
    publisher = lockstep.UncountedPublisher("/foreign", String)
    link = lockstep.host()
    server.attach_host(link)
    rospy.set_param("/lockstep/uri", server.uri)
    assert server.wait_for(["/a"], timeout=PATIENCE)
    now: int | None = 0
    while now is not None and not rospy.is_shutdown():
        publisher.publish(f"{now}")
        server.tick(now)
        link.receive()
        assert not any(link.collect()[1:])
        now = server.next_due_us(now)
    server.close()


def pinger(name: str, port: int, simulator_port: int) -> None:
    """Answer every datagram at once; publish nothing."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", port))
    got: list[bytes] = []
    calls = []

    def serve(expected, timeout: float):
        sock.settimeout(timeout)
        while len(got) < expected[port]:
            got.append(sock.recv(100))
            sock.sendto(got[-1], ("127.0.0.1", simulator_port))
        calls.append(len(got))
        lockstep.datagrams_sent(simulator_port, len(got))
        return {port: len(got)}

    lockstep.init_node(name, rate=50.0)
    lockstep.declare_udp([port], serve)
    lockstep.start()
    lockstep.spin()
    print("calls", *calls)


def patient(name: str) -> None:
    """Publish once a subscriber of a certain name is connected."""
    lockstep.init_node(name, rate=50.0)
    publisher = lockstep.Publisher("/news", String)
    assert not publisher.wait_for_subscriber("recorder", 0.0)
    print("waits", flush=True)
    assert publisher.wait_for_subscriber("recorder", PATIENCE)
    publisher.publish("the first")


def recorder(name: str) -> None:
    """End with the first message received; a node outside the lockstep."""
    rospy.init_node(name)
    print(rospy.wait_for_message("/news", String, PATIENCE).data)


# ---- the test's side ----


class Graph:
    """A separate ROS master and the processes started by a test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen] = {}
        self.ros_master = RosMaster()
        self.env = {
            **os.environ,
            "ROS_MASTER_URI": self.ros_master.uri,
            "ROS_HOSTNAME": "127.0.0.1",
            "ROS_LOG_DIR": str(folder),
            "ROS_HOME": str(folder),
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }
        self.master = xmlrpc.client.ServerProxy(self.ros_master.uri)

    def _popen(self, name: str, command: list[str], stdin: int | None = None, **env: str) -> subprocess.Popen:
        with open(self.folder / f"{name}.out", "w") as out:
            return subprocess.Popen(command, env={**self.env, **env}, stdin=stdin, stdout=out, stderr=subprocess.STDOUT)

    def set_param(self, name: str, value: object) -> None:
        self.master.setParam("/test", name, value)

    def start(
        self, role: str, name: str, *arguments: str, remap: list[str] | None = None, stdin: int | None = None
    ) -> subprocess.Popen:
        command = [sys.executable, __file__, role, name, *arguments, *(remap or [])]
        transcript = str(self.transcript_path(name))
        self.processes[name] = self._popen(name, command, stdin=stdin, TRANSCRIPT=transcript)
        return self.processes[name]

    def transcript_path(self, name: str) -> Path:
        return self.folder / f"{name}.transcript"

    def transcript(self, name: str) -> list[str]:
        return self.transcript_path(name).read_text().splitlines()

    def output(self, name: str) -> str:
        return (self.folder / f"{name}.out").read_text()

    def stop(self) -> None:
        for process in self.processes.values():
            process.kill()
        for process in self.processes.values():
            process.wait()
        self.ros_master.close()


def wait_until(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, f"in vain waited until {what}"
        time.sleep(0.02)


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    graph = Graph(tmp_path)
    yield graph
    graph.stop()


@pytest.fixture
def server(graph: Graph) -> Iterator[LockstepServer]:
    server = LockstepServer(hang_limit=PATIENCE, connect_limit=PATIENCE, busy_limit=PATIENCE)
    graph.set_param("/lockstep/uri", server.uri)
    yield server
    server.close()


def run(server: LockstepServer, end_us: int, start_us: int = -1, until: Callable[[], bool] = lambda: False) -> int:
    """Run barriers while the time is below ``end_us``; return the time of the next."""
    now = 0 if start_us < 0 else start_us
    while now is not None and now < end_us and not until():
        server.tick(now)
        now = server.next_due_us(now)
    return end_us if now is None else now


def start_three(graph: Graph, server: LockstepServer, lazy: str = "", seed: int = 0) -> None:
    # In reverse, so that the order of joining differs from the order of names.
    for name in reversed(RATES):
        others = [peer[1:] for peer in RATES]
        graph.start("participant", name[1:], str(seed if name == lazy else 0), *others)
    assert server.wait_for(list(RATES), timeout=PATIENCE), server.missing(list(RATES))


def due_times(rate: float, end_us: int) -> list[int]:
    schedule, times, now = Schedule(rate), [], -1
    while (now := schedule.after_us(now)) < end_us:
        times.append(now)
    return times


def expected_receptions(receiver: str, end_us: int) -> list[tuple[int, str, int, str]]:
    """Return the receptions required by the rule: (time, topic's source, time of sending, publisher)."""
    turns = due_times(RATES[receiver], end_us)
    receptions = []
    for previous, now in itertools.pairwise(turns):
        sent = [
            (turn, source[1:])
            for source in RATES
            for turn in due_times(RATES[source], end_us)
            if previous <= turn < now
        ]
        receptions += [(now, source, turn, source) for turn, source in sent]
        receptions += [(now, "shared", turn, source) for turn, source in sent]
    return receptions


def test_message_is_dispatched_in_the_first_turn_after_its_tick_at_any_speed(tmp_path: Path) -> None:
    transcripts = []
    for number, (lazy, seed) in enumerate([("", 0), ("/b", 5)]):
        folder = tmp_path / str(number)
        folder.mkdir()
        graph = Graph(folder)
        server = LockstepServer(hang_limit=PATIENCE, connect_limit=PATIENCE)
        try:
            graph.set_param("/lockstep/uri", server.uri)
            start_three(graph, server, lazy, seed)
            run(server, END_US)
            server.close()
            for name in RATES:
                assert graph.processes[name[1:]].wait(PATIENCE) == 0, graph.output(name[1:])
                assert "the simulation has ended" in graph.output(name[1:])
                assert "is gone" not in graph.output(name[1:])
                assert "did not arrive" not in graph.output(name[1:])
            transcripts.append({name: graph.transcript(name[1:]) for name in RATES})
        finally:
            server.close()
            graph.stop()
    for name, lines in transcripts[0].items():
        fields = [line.split() for line in lines]
        got = [(int(now), source, int(sent), publisher) for now, source, sent, publisher, _ in fields]
        assert got == expected_receptions(name, END_US)
    assert transcripts[1] == transcripts[0]


def test_others_continue_after_a_kill_and_the_node_may_rejoin(graph: Graph, server: LockstepServer) -> None:
    start_three(graph, server)
    now = run(server, 400_000)
    graph.processes["b"].kill()
    graph.processes["b"].wait()
    now = run(server, 800_000, now)
    assert sorted(server.participants) == ["/a", "/c"]
    graph.start("participant", "b", "0", "a", "c")
    assert server.wait_for(list(RATES), timeout=PATIENCE), server.missing(list(RATES))
    now = run(server, 1_200_000, now)
    server.close()
    for name in "abc":
        assert graph.processes[name].wait(PATIENCE) == 0, graph.output(name)
    seen = [line.split() for line in graph.transcript("a")]
    last = due_times(RATES["/a"], now)[-1]
    assert int(seen[-1][0]) == last
    from_b = [int(sent) for _, source, sent, _, _ in seen if source == "b"]
    turns = due_times(RATES["/b"], now)
    before = [turn for turn in turns if turn < 400_000]
    # Messages of its last turn before the kill were counted only if it had sent its DONE.
    assert {t for t in from_b if t < 800_000} in (set(before), set(before[:-1]))
    assert {t for t in from_b if t >= 800_000} == {t for t in turns if 800_000 <= t < last}


def test_duplicate_name_is_rejected_before_ros_shuts_down_its_owner(graph: Graph, server: LockstepServer) -> None:
    graph.start("participant", "a", "0", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    now = run(server, 100_000)
    first = graph.processes["a"]
    second = graph.start("traveller", "again", remap=["__name:=a"])
    wait_until(lambda: server.poll(0.0) or second.poll() is not None, "the second ends")
    assert second.returncode != 0
    assert "the name /a is taken by a participant connected from 127.0.0.1" in graph.output("again")
    assert f"process {first.pid}" in graph.output("again")
    run(server, 200_000, now)
    assert list(server.participants) == ["/a"]
    assert first.poll() is None


def test_crash_is_reported(graph: Graph) -> None:
    lines: list[tuple[int, str]] = []
    server = LockstepServer(log=lambda level, text: lines.append((level, text)))
    graph.set_param("/lockstep/uri", server.uri)
    node = graph.start("crasher", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    run(server, 100_000)
    assert node.wait(PATIENCE) == 1
    assert not server.participants
    crash = "ZeroDivisionError: integer division or modulo by zero"
    assert (logging.WARNING, f"participant /a leaves: it crashed: {crash}") in lines
    server.close()


def test_breakpoint_holds_the_simulation_and_drops_no_participant(graph: Graph) -> None:
    server = LockstepServer(hang_limit=2.5)
    graph.set_param("/lockstep/uri", server.uri)
    node = graph.start("thinker", "a", stdin=subprocess.PIPE)
    assert server.wait_for(["/a"], timeout=PATIENCE)
    barrier = threading.Thread(target=server.tick, args=(0,), daemon=True)
    barrier.start()
    wait_until(lambda: "stands" in graph.output("a"), "the node has its turn")
    barrier.join(4.0)  # much longer than the hang limit, which the node's keep-alives must extend
    assert barrier.is_alive()
    assert list(server.participants) == ["/a"]
    node.stdin.close()
    barrier.join(PATIENCE)
    assert not barrier.is_alive()
    run(server, 100_000, 20_000)
    assert list(server.participants) == ["/a"]
    server.close()


def test_dead_node_is_dropped_while_its_child_holds_the_connection(graph: Graph) -> None:
    server = LockstepServer(hang_limit=60.0)
    graph.set_param("/lockstep/uri", server.uri)
    node = graph.start("parent", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    barrier = threading.Thread(target=run, args=(server, 100_000), daemon=True)
    barrier.start()
    wait_until(lambda: "child" in graph.output("a"), "the node has a child")
    node.kill()
    node.wait()
    barrier.join(PATIENCE)
    os.kill(int(graph.output("a").split()[-1]), signal.SIGKILL)
    assert not barrier.is_alive()
    assert not server.participants
    server.close()


def test_reset_of_time(graph: Graph, server: LockstepServer) -> None:
    graph.start("traveller", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    run(server, 100_000)
    server.reset_time(0)
    run(server, 60_000)
    server.close()
    assert graph.processes["a"].wait(PATIENCE) == 0
    first = [f"turn {t}" for t in range(0, 100_000, 20_000)]
    assert graph.transcript("a") == [*first, "back 0", *first[:3]]


def test_reset_to_the_time_of_the_last_turn(graph: Graph, server: LockstepServer) -> None:
    graph.start("traveller", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    server.reset_time(0)  # before its first turn: has no effect
    for _ in range(3):
        run(server, 20_000)
        server.reset_time(0)
    server.close()
    assert graph.processes["a"].wait(PATIENCE) == 0
    assert graph.transcript("a") == ["turn 0", "back 0", "turn 0", "back 0", "turn 0"]


def test_callback_may_unregister_another_subscriber_and_reset_ends_a_sleep(
    graph: Graph, server: LockstepServer
) -> None:
    graph.start("sleeper", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    run(server, 200_000)
    server.reset_time(0)
    run(server, 60_000)
    server.close()
    assert graph.processes["a"].wait(PATIENCE) == 0, graph.output("a")
    assert graph.transcript("a") == ["heard", "slept until 0"]


def test_late_outside_subscriber_to_a_latched_topic_changes_nothing(graph: Graph, server: LockstepServer) -> None:
    graph.start("stamper", "a")
    graph.start("reader_of_stamps", "b")
    assert server.wait_for(["/a", "/b"], timeout=PATIENCE)
    now = run(server, 40_000)
    graph.start("late_rider", "rider")
    wait_until(lambda: "got it" in graph.output("rider"), "the rider has the latched message")
    run(server, 420_000, now)
    server.close()
    assert graph.processes["b"].wait(PATIENCE) == 0
    assert graph.transcript("b") == ["1", "2", "3", "4"]


def test_participant_may_have_plain_subscribers_too(graph: Graph, server: LockstepServer) -> None:
    graph.start("participant", "a", "0")
    graph.start("mixer", "b")
    assert server.wait_for(["/a", "/b"], timeout=PATIENCE)
    now, end = run(server, 100_000), time.monotonic() + PATIENCE
    while "plain" not in graph.transcript("b") and time.monotonic() < end:  # rospy makes its connection at any time
        now = run(server, now + 20_000, now)
    assert "plain" in graph.transcript("b")
    run(server, now + 100_000, now)
    assert "counted" in graph.transcript("b")
    assert "waiting for messages" not in graph.output("b")


def test_foreign_latched_message_is_dispatched_in_the_next_turn(graph: Graph, server: LockstepServer) -> None:
    graph.start("talker", "talker")
    graph.start("participant", "a", "0", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    now = 0

    def heard() -> bool:
        return any("foreign hello" in line for line in graph.transcript("a"))

    end = time.monotonic() + PATIENCE
    while not heard() and time.monotonic() < end:
        now = run(server, now + 20_000, now)
    assert heard()
    assert sum("foreign hello" in line for line in graph.transcript("a")) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_a_node_waiting_for_its_turn(graph: Graph, server: LockstepServer, number: int) -> None:
    graph.start("participant", "a", "0", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    run(server, 100_000)
    graph.processes["a"].send_signal(number)
    graph.processes["a"].wait(PATIENCE)  # there is no further tick
    server.poll(PATIENCE)
    assert not server.participants


def test_stopped_outside_subscriber_does_not_stop_the_simulation(graph: Graph, server: LockstepServer) -> None:
    rider = graph.start("listener", "rider")
    graph.start("flood", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)

    now = 0

    def connected() -> bool:
        nonlocal now
        now = run(server, now + 20_000, now)
        return "1" in graph.transcript("a")

    wait_until(connected, "the listener is connected")
    rider.send_signal(signal.SIGSTOP)
    run(server, now + 1_000_000, now)
    assert list(server.participants) == ["/a"]
    rider.send_signal(signal.SIGCONT)


def test_messages_larger_than_socket_buffers_arrive_in_the_next_turn(graph: Graph, server: LockstepServer) -> None:
    for name in "ab":
        graph.start("heavy", name)
    assert server.wait_for(["/a", "/b"], timeout=PATIENCE)
    run(server, 220_000)
    server.close()
    for name in "ab":
        assert graph.processes[name].wait(PATIENCE) == 0, graph.output(name)
        assert "did not arrive" not in graph.output(name)
        seen = [line.split() for line in graph.transcript(name)]
        turns = range(1, 11)
        assert [(int(now), int(sent), int(size)) for now, sent, size in seen] == [
            (turn * 20_000, turn - 1, 2_000_003 + turn - 1) for turn in turns for _ in range(3)
        ]


def test_subscriber_may_unregister_and_subscribe_again(graph: Graph, server: LockstepServer) -> None:
    graph.start("participant", "a", "0")
    graph.start("churner", "churner")
    assert server.wait_for(["/a", "/churner"], timeout=PATIENCE)
    now = run(server, 1_000_000)
    assert sorted(server.participants) == ["/a", "/churner"]
    server.close()
    assert graph.processes["churner"].wait(PATIENCE) == 0, graph.output("churner")
    assert "did not arrive" not in graph.output("churner")
    lines = [line.split() for line in graph.transcript("churner")]
    assert [line for line in lines if line[1] == "connections"] == [
        [str(turn), "connections", "1"] for turn in range(3, 20, 4)
    ]
    # It unregisters in turn k + 3, after the message of turn k + 2. It receives that of turn k + 1 only if the
    # publisher had noticed the end of the previous connection by then: the simulation then waited for the new one.
    times = due_times(50.0, now)
    for turn in range(0, 20, 4):
        sent = [int(line[1]) for line in lines if line[0] == str(turn)]
        assert sent in (times[turn + 1 : turn + 3], times[turn : turn + 3], times[turn + 2 : turn + 3])


def test_simulator_messages_before_a_tick_are_dispatched_in_it(graph: Graph) -> None:
    process = graph.start("simulator", "simulator")
    graph.set_param("/lockstep/wait", True)
    graph.start("participant", "a", "0", "simulator")
    assert process.wait(PATIENCE) == 0, graph.output("simulator")
    assert graph.processes["a"].wait(PATIENCE) == 0
    seen = [line.split() for line in graph.transcript("a") if " simulator " in line]
    assert [int(now) for now, *_ in seen] == due_times(RATES["/a"], 300_000)
    assert all(sent == now for now, _, sent in seen)


def start_hearing(graph: Graph, end_us: int, back_us: int = 0, lazy: str = "") -> subprocess.Popen:
    process = graph.start("hearing_simulator", "simulator", str(end_us), str(back_us))
    graph.set_param("/lockstep/wait", True)
    for seed, name in enumerate(reversed(RATES), 1):
        graph.start("participant", name[1:], str(seed if name == lazy else 0), *[peer[1:] for peer in RATES])
    return process


def sent_to_simulator(times: list[int]) -> list[tuple[int, str, int, str]]:
    """Return the receptions required of a simulator: (time, topic's source, time of sending, publisher)."""
    heard = []
    for now in times:
        senders = [source[1:] for source in RATES if now in due_times(RATES[source], now + 1)]
        heard += [(now, source, now, source) for source in ("b", "a", "c") if source in senders]
        heard += [(now, "shared", now, source) for source in sorted(senders)]
    return heard


def all_ticks(end_us: int) -> list[int]:
    return sorted({turn for rate in RATES.values() for turn in due_times(rate, end_us)})


@pytest.mark.parametrize("lazy", ["", "/b"])
def test_simulator_receives_in_each_tick_the_messages_sent_in_it(graph: Graph, lazy: str) -> None:
    process = start_hearing(graph, 600_000, lazy=lazy)
    assert process.wait(PATIENCE) == 0, graph.output("simulator")
    lines = [line.split() for line in graph.transcript("simulator")]
    seen = [(int(now), source, int(sent), publisher) for now, source, sent, publisher, _ in lines]
    assert seen == sent_to_simulator(all_ticks(600_000))


def test_simulator_receives_the_same_after_a_reset(graph: Graph) -> None:
    process = start_hearing(graph, 400_000, back_us=300_000)
    assert process.wait(PATIENCE) == 0, graph.output("simulator")
    lines = [line.split() for line in graph.transcript("simulator")]
    (back,) = [index for index, line in enumerate(lines) if line[1] == "back"]
    for part, end in ((lines[:back], int(lines[back][0]) + 1), (lines[back + 1 :], 400_000)):
        seen = [(int(now), source, int(sent), publisher) for now, source, sent, publisher, _ in part]
        assert seen == sent_to_simulator(all_ticks(end))


def test_simulator_receives_after_a_death_and_from_outside_publishers(graph: Graph) -> None:
    process = start_hearing(graph, 10**12)

    def heard(what: str) -> bool:
        path = graph.transcript_path("simulator")
        return path.exists() and any(what in line for line in path.read_text().splitlines())

    wait_until(lambda: heard(" c "), "the simulator hears c")
    graph.processes["c"].kill()
    graph.processes["c"].wait()
    count = len(graph.transcript("simulator"))
    wait_until(lambda: len(graph.transcript("simulator")) > count + 50, "the others fly on")
    graph.start("talker", "rider")
    wait_until(lambda: heard(" f hello"), "the simulator hears the free rider")
    lines = [line.split() for line in graph.transcript("simulator")]
    last = max(int(line[0]) for line in lines if line[1] == "c")
    later = [line for line in lines if int(line[0]) > last + 20_000 and line[1] != "f"]
    assert {line[3] for line in later} == {"a", "b"}
    assert all(line[0] == line[2] for line in lines if line[1] != "f")
    process.kill()


def test_uncounted_messages_are_not_waited_for(graph: Graph) -> None:
    process = graph.start("announcer", "announcer")
    graph.set_param("/lockstep/wait", True)
    graph.start("participant", "a", "0", "a")

    def heard() -> list[list[str]]:
        return [line.split() for line in graph.transcript("a") if " foreign " in line]

    wait_until(lambda: graph.transcript_path("a").exists() and len(heard()) > 2, "a hears the announcer")
    process.send_signal(signal.SIGINT)
    assert process.wait(PATIENCE) == 0, graph.output("announcer")
    assert graph.processes["a"].wait(PATIENCE) == 0
    assert all(int(sent) <= int(now) for now, _, sent in heard())
    assert "waiting for messages" not in graph.output("a")


def test_datagrams_are_waited_for(graph: Graph, server: LockstepServer) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        own_port = sock.getsockname()[1]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(("127.0.0.1", 0))
            port = other.getsockname()[1]
        server.open_datagram_ports([own_port])
        graph.start("pinger", "pinger", str(port), str(own_port))
        assert server.wait_for(["/pinger"], timeout=PATIENCE)
        sent = 0
        for index, number in enumerate([2, 0, 3, 1]):
            # The counted datagrams are sent after the tick has begun: the node has to wait for them.
            late = threading.Timer(0.05, lambda n=number: [sock.sendto(b"x", ("127.0.0.1", port)) for _ in range(n)])
            late.start()
            sent += number
            server.tick(index * 20_000, {port: sent})
            late.join()
            assert server.datagrams_expected.get(own_port, 0) == sent
        sock.settimeout(PATIENCE)
        assert b"".join(sock.recv(100) for _ in range(sent)) == b"x" * sent
    server.close()
    assert graph.processes["pinger"].wait(PATIENCE) == 0, graph.output("pinger")
    assert "calls 2 5 6" in graph.output("pinger")


def test_without_a_simulator_the_node_is_an_ordinary_node(graph: Graph) -> None:
    assert graph.start("alone", "alone").wait(PATIENCE) == 0, graph.output("alone")
    assert "alone is well" in graph.output("alone")


def test_without_lockstep_turns_follow_simulated_time(graph: Graph) -> None:
    graph.set_param("/use_sim_time", True)
    assert graph.start("on_clock", "on_clock").wait(PATIENCE) == 0, graph.output("on_clock")
    assert "on the clock" in graph.output("on_clock")


@pytest.mark.parametrize("wall", [True, False])
def test_corrected_wall_clock_is_not_a_reset(monkeypatch: pytest.MonkeyPatch, wall: bool) -> None:
    from xtdrone_lockstep.client import api

    times = iter([rospy.Time(10), rospy.Time(5)])
    resets: list[str] = []
    monkeypatch.setattr(api.rospy.Time, "now", staticmethod(lambda: next(times)))
    monkeypatch.setattr(api.rospy.rostime, "is_wallclock", lambda: wall)
    monkeypatch.setattr(api.this_node, "reset_hooks", [lambda: resets.append("reset")])
    api.Rate._sleep_free(SimpleNamespace(sleep=lambda: None))
    assert resets == ([] if wall else ["reset"])


def test_publisher_waits_for_a_named_subscriber(graph: Graph) -> None:
    graph.start("patient", "patient")
    wait_until(lambda: "waits" in graph.output("patient"), "the publisher waits")
    other = graph.start("recorder", "other")  # the barrier does not wait for this node
    assert graph.start("recorder", "recorder").wait(PATIENCE) == 0, graph.output("recorder")
    assert graph.processes["patient"].wait(PATIENCE) == 0, graph.output("patient")
    assert graph.output("recorder").endswith("the first\n")
    assert other.poll() in (None, 0)


def test_the_private_parameter_opts_out(graph: Graph, server: LockstepServer) -> None:
    graph.set_param("/alone/lockstep", False)
    assert graph.start("alone", "alone").wait(PATIENCE) == 0, graph.output("alone")
    assert not server.participants


def test_node_started_first_waits_for_the_simulator(graph: Graph) -> None:
    graph.set_param("/lockstep/wait", True)
    graph.start("participant", "a", "0", "a")

    def there() -> bool:
        return any("/a" in nodes for _, nodes in graph.master.getSystemState("/t")[2][0])

    wait_until(there, "the node registers")
    server = LockstepServer()
    graph.set_param("/lockstep/uri", server.uri)
    assert server.wait_for(["/a"], timeout=PATIENCE)
    run(server, 100_000)
    assert list(server.participants) == ["/a"]
    server.close()


if __name__ == "__main__":
    role, name, *rest = sys.argv[1:]
    if role == "participant":
        participant(name, int(rest[0]), [peer for peer in rest[1:] if ":=" not in peer])
    elif role == "pinger":
        pinger(name, int(rest[0]), int(rest[1]))
    elif role == "hearing_simulator":
        hearing_simulator(name, *rest)
    else:
        roles = [
            alone,
            patient,
            recorder,
            on_clock,
            talker,
            listener,
            flood,
            heavy,
            churner,
            thinker,
            sleeper,
            mixer,
            crasher,
            stamper,
            reader_of_stamps,
            late_rider,
            parent,
            traveller,
            simulator,
            announcer,
        ]
        {function.__name__: function for function in roles}[role](name)
