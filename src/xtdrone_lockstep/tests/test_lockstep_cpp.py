"""The lockstep of C++ nodes, among themselves and with Python nodes; this test plays the simulator.

Run as a program, this file is one of the Python nodes; the C++ nodes are in lockstep_test_node.cpp, built by catkin.
"""

from __future__ import annotations

import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from test_lockstep_nodes import PATIENCE, Graph, due_times, heavy, run, wait_until

import xtdrone_lockstep as lockstep
from xtdrone_lockstep import unix_sockets
from xtdrone_lockstep.protocol import Digest
from xtdrone_lockstep.server import LockstepServer

try:
    import rospy
    from geometry_msgs.msg import PointStamped
    from rosgraph_msgs.msg import Clock
    from std_msgs.msg import Header, String
except ImportError:
    rospy = None

NODE = shutil.which(
    "lockstep_test_node",
    path=os.pathsep.join(
        f"{prefix}/lib/xtdrone_lockstep" for prefix in os.environ.get("CMAKE_PREFIX_PATH", "").split(os.pathsep)
    ),
)

pytestmark = pytest.mark.skipif(
    rospy is None or NODE is None,
    reason="needs ROS 1 (rosmaster, rospy) and the built workspace (lockstep_test_node)",
)

RATES = {"a": 50.0, "b": 30.0, "c": 20.0}
END_US = 1_000_000


# ---- the Python nodes ----


def participant(name: str, rate: float, seed: int, peers: list[str]) -> None:
    """Play the same role as the C++ node of this name."""
    lockstep.init_node(name, rate=rate)
    lazy = random.Random(seed)
    checksum = 14695981039346656037  # FNV-1a
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process

    def take(message: String, source: str) -> None:
        nonlocal checksum
        for byte in message.data.encode():
            checksum = ((checksum ^ byte) * 1099511628211) % 2**64
        print(rospy.Time.now().to_nsec() // 1000, source, message.data, file=out)

    publishers = [lockstep.Publisher(f"/from_{name}", String), lockstep.Publisher("/shared", String)]
    keep = [lockstep.Subscriber(f"/from_{peer}", String, take, peer) for peer in peers]
    keep.append(lockstep.Subscriber("/shared", String, take, "shared"))
    keep.append(lockstep.Subscriber("/foreign", String, take, "foreign"))
    lockstep.start()

    def step() -> None:
        if seed and lazy.random() < 0.25:
            time.sleep(0.02)
        now = rospy.Time.now().to_nsec() // 1000
        for publisher in publishers:
            publisher.publish(f"{now} {name} {checksum:016x}")

    lockstep.spin(step)


def stamper(name: str) -> None:
    """Play the same role as the C++ node of this name."""
    lockstep.init_node(name, rate=50.0)
    publisher = lockstep.Publisher("/stamps", PointStamped)
    lockstep.start()
    lockstep.spin(lambda: publisher.publish(PointStamped(header=Header(stamp=rospy.Time.now(), frame_id="map"))))


def sender(name: str, rate: str) -> None:
    """Play the same role as the C++ node of this name."""
    lockstep.init_node(name, rate=float(rate))
    publishers = [lockstep.Publisher("/passing", String), lockstep.Publisher("/held", String, latch=True)]
    lockstep.start()

    def step() -> None:
        for publisher in publishers:
            publisher.publish(f"{rospy.Time.now().to_nsec() // 1000} {name}")

    lockstep.spin(step)


def reader(name: str, rate: str) -> None:
    """Play the same role as the C++ node of this name."""
    lockstep.init_node(name, rate=float(rate))
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process

    def note(*words: str) -> None:
        print(rospy.Time.now().to_nsec() // 1000, *words, file=out)

    _passing = lockstep.Subscriber("/passing", String, lambda message: note("passing", message.data))
    _held = lockstep.Subscriber("/held", String, lambda message: note("held", message.data))
    lockstep.add_reset_hook(lambda: note("reset"))
    lockstep.start()
    lockstep.spin()


def talker(name: str) -> None:
    """Latch one message; a node outside the lockstep."""
    rospy.init_node(name)
    publisher = rospy.Publisher("/foreign", String, latch=True, queue_size=1)
    publisher.publish("hello")
    rospy.spin()


def listener(name: str) -> None:
    """Subscribe; a node outside the lockstep."""
    rospy.init_node(name)
    out = open(os.environ["TRANSCRIPT"], "w", buffering=1)  # noqa: SIM115 - ends with the process
    _words = rospy.Subscriber("/foreign", String, lambda message: print(message.data, file=out))
    _flood = rospy.Subscriber("/flood", String, lambda message: None)
    rospy.spin()


def clock(name: str) -> None:
    """Publish wrong times as fast as possible."""
    rospy.init_node(name, disable_rostime=True)
    publisher = rospy.Publisher("/clock", Clock, queue_size=10)
    while not rospy.is_shutdown():
        for seconds in (0, 1, 1_000_000):
            publisher.publish(Clock(rospy.Time(seconds)))
        time.sleep(0.001)


def rewinder(name: str) -> None:
    """Publish the time from 100 s, and from 50 s after SIGUSR1."""
    rospy.init_node(name, disable_rostime=True)
    publisher = rospy.Publisher("/clock", Clock, queue_size=10)
    now = 100_000  # 0.1 s, in us

    def rewind(*_: object) -> None:
        nonlocal now
        now = 50_000

    signal.signal(signal.SIGUSR1, rewind)
    while not rospy.is_shutdown():
        now += 1
        publisher.publish(Clock(rospy.Time(*divmod(now * 10**6, 10**9))))
        time.sleep(0.001)


# ---- the test's side ----


@dataclass
class Node:
    """One node of a graph: its language, and a seed for random delays (0 for none)."""

    cpp: bool
    seed: int = 0


class MixedGraph(Graph):
    """A graph that can start C++ nodes too."""

    def start_cpp(self, role: str, name: str, *arguments: str) -> subprocess.Popen:
        command = [str(NODE), role, name, *arguments]
        self.processes[name] = self._popen(name, command, TRANSCRIPT=str(self.transcript_path(name)))
        return self.processes[name]

    def start(self, role: str, name: str, *arguments: str) -> subprocess.Popen:
        command = [sys.executable, __file__, role, name, *arguments]
        self.processes[name] = self._popen(name, command, TRANSCRIPT=str(self.transcript_path(name)))
        return self.processes[name]

    def start_participants(self, server: LockstepServer, nodes: dict[str, Node]) -> None:
        for name in reversed(nodes):
            start = self.start_cpp if nodes[name].cpp else self.start
            start("participant", name, str(RATES[name]), str(nodes[name].seed), *nodes)
        assert server.wait_for(list(nodes), timeout=PATIENCE), server.missing(list(nodes))

    def ended(self, name: str, status: int = 0) -> str:
        """Wait for a node to end with an exit status and return its output."""
        assert self.processes[name].wait(PATIENCE) == status, self.output(name)
        return self.output(name)


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[MixedGraph]:
    graph = MixedGraph(tmp_path)
    yield graph
    graph.stop()


@pytest.fixture
def server(graph: MixedGraph) -> Iterator[LockstepServer]:
    server = LockstepServer(hang_limit=PATIENCE, connect_limit=PATIENCE, busy_limit=PATIENCE)
    graph.set_param("/lockstep/uri", server.uri)
    yield server
    server.close()


def expected_receptions(receiver: str, end_us: int) -> list[tuple[int, str, int, str]]:
    """Return the receptions required by the rule: (time, topic's source, time of sending, publisher)."""
    times = {name: due_times(rate, end_us) for name, rate in RATES.items()}
    receptions = []
    for previous, now in zip(times[receiver], times[receiver][1:], strict=False):
        sent = [(turn, source) for source in RATES for turn in times[source] if previous <= turn < now]
        receptions += [(now, source, turn, source) for turn, source in sent]
        receptions += [(now, "shared", turn, source) for turn, source in sent]
    return receptions


def test_message_is_dispatched_in_the_first_turn_after_its_tick_in_either_language(tmp_path: Path) -> None:
    graphs = [
        {"a": Node(cpp=True), "b": Node(cpp=True), "c": Node(cpp=True)},
        {"a": Node(cpp=True, seed=3), "b": Node(cpp=False), "c": Node(cpp=True)},
        {"a": Node(cpp=False, seed=5), "b": Node(cpp=True, seed=7), "c": Node(cpp=False)},
    ]
    transcripts = []
    for number, nodes in enumerate(graphs):
        folder = tmp_path / str(number)
        folder.mkdir()
        graph = MixedGraph(folder)
        server = LockstepServer(hang_limit=PATIENCE, connect_limit=PATIENCE)
        try:
            graph.set_param("/lockstep/uri", server.uri)
            graph.start_participants(server, nodes)
            run(server, END_US)
            server.close()
            for name in nodes:
                said = graph.ended(name)
                assert "the simulation has ended" in said
                assert "is gone" not in said
                assert "did not arrive" not in said
                assert "waiting for messages" not in said
            transcripts.append({name: graph.transcript(name) for name in nodes})
        finally:
            server.close()
            graph.stop()
    for name, lines in transcripts[0].items():
        fields = [line.split() for line in lines]
        got = [(int(now), source, int(sent), publisher) for now, source, sent, publisher, _ in fields]
        assert got == expected_receptions(name, END_US)
    assert transcripts[1] == transcripts[0]
    assert transcripts[2] == transcripts[0]


def test_killed_node_is_dropped_and_may_rejoin(graph: MixedGraph, server: LockstepServer) -> None:
    graph.start_participants(server, {"a": Node(cpp=True), "b": Node(cpp=True), "c": Node(cpp=False)})
    now = run(server, 400_000)
    graph.processes["b"].kill()
    graph.processes["b"].wait()
    now = run(server, 700_000, now)
    assert sorted(server.participants) == ["/a", "/c"]
    graph.start_cpp("participant", "b", str(RATES["b"]), "0", *RATES)
    assert server.wait_for(["/b"], timeout=PATIENCE), server.missing(["/b"])
    now = run(server, 1_000_000, now)
    server.close()
    for name in RATES:
        assert "did not arrive" not in graph.ended(name)
    turns = due_times(RATES["b"], now)
    before = [turn for turn in turns if turn < 400_000]
    for name in "ac":
        seen = [line.split() for line in graph.transcript(name)]
        last = due_times(RATES[name], now)[-1]
        assert int(seen[-1][0]) == last
        from_b = [int(sent) for _, source, sent, _, _ in seen if source == "b"]
        # Messages of its last turn before the kill were counted only if it had sent its DONE.
        assert [t for t in from_b if t < 700_000] in (before, before[:-1])
        assert [t for t in from_b if t >= 700_000] == [t for t in turns if 700_000 <= t < last]


def test_second_node_of_a_name_is_rejected_and_the_first_continues(graph: MixedGraph, server: LockstepServer) -> None:
    graph.start_cpp("participant", "a", "50", "0", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    first = graph.processes["a"]
    log = graph.folder / "second.out"
    with open(log, "w") as out:
        command = [str(NODE), "participant", "a", "50", "0", "a"]
        second = subprocess.Popen(command, env=graph.env, stdout=out, stderr=subprocess.STDOUT)
    now = 0
    end = time.monotonic() + PATIENCE
    while second.poll() is None and time.monotonic() < end:
        now = run(server, now + 20_000, now)
    assert second.wait(PATIENCE) == 1
    assert "the name /a is taken by a participant connected from" in log.read_text()
    now = run(server, now + 200_000, now)
    assert list(server.participants) == ["/a"]
    assert first.poll() is None


def test_other_protocol_version_is_rejected_with_the_reason(graph: MixedGraph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("xtdrone_lockstep.server.frame_checks.VERSION", 99)
    server = LockstepServer()
    graph.set_param("/lockstep/uri", server.uri)
    process = graph.start_cpp("participant", "a", "50", "0")
    end = time.monotonic() + PATIENCE
    while process.poll() is None and time.monotonic() < end:
        server.poll(0.05)
    server.close()
    assert process.wait(PATIENCE) == 1
    assert "/a uses lockstep version 2, the simulator 99" in graph.output("a")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_a_node_waiting_for_its_turn(
    graph: MixedGraph, server: LockstepServer, number: signal.Signals
) -> None:
    process = graph.start_cpp("participant", "a", "50", "0", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    run(server, 100_000)
    process.send_signal(number)
    assert process.wait(PATIENCE) == 0  # there are no more ticks
    server.poll(PATIENCE)
    assert not server.participants


def test_clock_topic_does_not_change_the_time(graph: MixedGraph, server: LockstepServer) -> None:
    graph.set_param("/use_sim_time", True)
    graph.start("clock", "clock")
    wait_until(lambda: "/clock" in [topic for topic, _ in graph.master.getPublishedTopics("/t", "")[2]], "it publishes")
    graph.start_cpp("participant", "a", "50", "11", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    run(server, 600_000)
    subscribers = dict(graph.master.getSystemState("/t")[2][1])
    server.close()
    graph.ended("a")
    assert "/a" not in subscribers.get("/clock", [])
    times = [int(line.split()[0]) for line in graph.transcript("a") if " a " in line]
    assert sorted(set(times)) == due_times(50.0, 600_000)[1:]


def test_foreign_latched_message_arrives_once(graph: MixedGraph, server: LockstepServer) -> None:
    graph.start("talker", "talker")
    graph.start_cpp("participant", "a", "50", "0", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    now = 0

    def heard() -> bool:
        nonlocal now
        now = run(server, now + 20_000, now)
        return any("foreign hello" in line for line in graph.transcript("a"))

    wait_until(heard, "the message comes")
    run(server, now + 200_000, now)
    assert sum("foreign hello" in line for line in graph.transcript("a")) == 1


def test_latched_message_arrives_once_at_every_subscriber(graph: MixedGraph, server: LockstepServer) -> None:
    graph.start_cpp("latcher", "latcher")
    assert server.wait_for(["/latcher"], timeout=PATIENCE)
    run(server, 100_000)
    graph.start("listener", "rider")
    graph.start_cpp("participant", "a", "50", "0")
    graph.start("participant", "b", "50", "0")
    assert server.wait_for(["/a", "/b"], timeout=PATIENCE), server.missing(["/a", "/b"])
    now = 100_000

    def heard() -> bool:
        nonlocal now
        now = run(server, now + 20_000, now)
        path = graph.transcript_path("rider")
        return path.exists() and "hello" in path.read_text()

    wait_until(heard, "the rider hears it")
    now = run(server, now + 100_000, now)
    server.close()
    graph.ended("a")
    graph.ended("b")
    for name in "ab":
        assert [line.split()[1:] for line in graph.transcript(name) if "foreign" in line] == [["foreign", "hello"]]
    assert graph.transcript("rider") == ["hello"]


@pytest.mark.parametrize("other", ["cpp", "python"])
def test_messages_larger_than_socket_buffers_arrive_in_the_next_turn(
    graph: MixedGraph, server: LockstepServer, other: str
) -> None:
    graph.start_cpp("heavy", "a")
    (graph.start_cpp if other == "cpp" else graph.start)("heavy", "b")
    assert server.wait_for(["/a", "/b"], timeout=PATIENCE)
    run(server, 220_000)
    server.close()
    for name in "ab":
        assert "did not arrive" not in graph.ended(name)
        seen = [line.split() for line in graph.transcript(name)]
        assert [(int(now), int(sent), int(size)) for now, sent, size in seen] == [
            (turn * 20_000, turn - 1, 2_000_003 + turn - 1) for turn in range(1, 11) for _ in range(3)
        ]


def test_stopped_outside_subscriber_blocks_nothing(graph: MixedGraph, server: LockstepServer) -> None:
    rider = graph.start("listener", "rider")
    graph.start_cpp("flood", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    now = 0

    def connected() -> bool:
        nonlocal now
        now = run(server, now + 20_000, now)
        return any(line.startswith("1 ") for line in graph.transcript("a"))

    wait_until(connected, "the listener is connected")
    rider.send_signal(signal.SIGSTOP)
    run(server, now + 4_000_000, now)
    rider.send_signal(signal.SIGCONT)
    assert list(server.participants) == ["/a"]
    kilobytes = [int(line.split()[1]) for line in graph.transcript("a")]
    assert len(kilobytes) > 200
    assert kilobytes[-1] - kilobytes[0] < 30_000, "200 messages of 500 kB are 100 MB"


def test_topics_may_be_added_and_removed(graph: MixedGraph, server: LockstepServer) -> None:
    graph.start_cpp("participant", "a", "50", "0", "churner")
    graph.start_cpp("churner", "churner")
    assert server.wait_for(["/a", "/churner"], timeout=PATIENCE)
    now = run(server, 1_000_000)
    assert sorted(server.participants) == ["/a", "/churner"]
    server.close()
    assert "did not arrive" not in graph.ended("churner")
    assert "waiting for messages" not in graph.ended("a")
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
    # Its own topic exists from turn k to k + 3 and has messages in k + 1 and k + 2.
    heard = [line.split() for line in graph.transcript("a") if " churner " in line]
    sent = [int(line[2]) for line in heard]
    assert set(sent) <= {times[turn + i] for turn in range(0, 20, 4) for i in (1, 2)}
    assert {times[1], times[2]} <= set(sent)
    assert all(int(line[0]) == int(line[2]) + 20_000 for line in heard)


def test_reset_hook_runs_before_callbacks(graph: MixedGraph, server: LockstepServer) -> None:
    graph.start_participants(server, {"a": Node(cpp=True), "b": Node(cpp=False)})
    run(server, 300_000)
    server.reset_time(0)
    run(server, 200_000)
    server.close()
    graph.ended("a")
    lines = [line.split() for line in graph.transcript("a")]
    reset = lines.index(["0", "reset"])
    assert [line for line in lines if line[1] == "reset"] == [["0", "reset"]]
    assert {int(line[0]) for line in lines[:reset]} == set(due_times(50.0, 300_000)[1:])
    # Messages in flight at the reset are void: the first turn after it receives none.
    assert {int(line[0]) for line in lines[reset + 1 :]} == set(due_times(50.0, 200_000)[1:])


def test_reset_is_detected_by_an_earlier_node(graph: MixedGraph, server: LockstepServer) -> None:
    graph.start_cpp("reader", "a", "50")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    server.tick(20_000)
    server.reset_time(0)
    for now in (20_000, 40_000, 60_000):
        server.tick(now)
    server.close()
    graph.ended("a")
    assert graph.transcript("a") == ["20000 reset"]


def test_reset_ends_a_sleep_and_a_failing_hook_ends_nothing(graph: MixedGraph, server: LockstepServer) -> None:
    graph.start_cpp("sleeper", "a", "50")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    run(server, 300_000)
    server.reset_time(0)
    run(server, 100_000)
    server.close()
    assert "bad reset hook: as asked" in graph.ended("a")
    assert graph.transcript("a") == ["0 reset", "0 awake"]


def test_clock_jump_back_is_detected_without_lockstep(graph: MixedGraph) -> None:
    graph.set_param("/use_sim_time", True)
    clock = graph.start("rewinder", "clock")
    graph.start_cpp("sleeper", "a", "50")
    # Time starts at 0, before the first /clock message.
    wait_until(lambda: graph.transcript_path("a").exists() and graph.transcript("a"), "it has the time")
    clock.send_signal(signal.SIGUSR1)
    wait_until(lambda: len(graph.transcript("a")) == 3, "it notices")
    graph.processes["a"].send_signal(signal.SIGINT)
    assert "bad reset hook: as asked" in graph.ended("a")
    (began, _), (back, what), (awake, _) = [line.split() for line in graph.transcript("a")]
    assert what == "reset"
    assert int(began) > 100_000_000
    assert 50_000_000 < int(back) <= int(awake) < 60_000_000


def test_dropped_node_reports_it(graph: MixedGraph) -> None:
    server = LockstepServer(hang_limit=1.0)
    graph.set_param("/lockstep/uri", server.uri)
    process = graph.start_cpp("participant", "a", "50", "0", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    now = run(server, 100_000)
    process.send_signal(signal.SIGSTOP)
    run(server, now + 40_000, now)
    assert not server.participants
    process.send_signal(signal.SIGCONT)
    said = graph.ended("a", status=1)
    server.close()
    assert f"the simulator at {server.uri} has dropped this node: it was silent for" in said
    assert "is gone" not in said


def test_reset_voids_pending_messages_unless_latched(graph: MixedGraph, server: LockstepServer) -> None:
    # The C++ sender is first by name.
    senders, readers = {"s_cpp": 50.0, "s_py": 50.0}, {"r_cpp": 20.0, "r_py": 20.0}
    for role, nodes in (("reader", readers), ("sender", senders)):
        for name, rate in nodes.items():
            (graph.start_cpp if name.endswith("cpp") else graph.start)(role, name, str(rate))
    names = [*senders, *readers]
    assert server.wait_for(names, timeout=PATIENCE), server.missing(names)
    run(server, 290_000)
    server.reset_time(0)
    run(server, 200_000)
    server.close()
    for name in names:
        assert "did not arrive" not in graph.ended(name)

    def heard(now: int, topic: str, sent: list[int]) -> list[str]:
        return [f"{now} {topic} {time_us} {name}" for name in senders for time_us in sent]

    def heard_until(end_us: int) -> list[str]:
        lines: list[str] = []
        for previous, now in itertools.pairwise(due_times(20.0, end_us)):
            sent = [turn for turn in due_times(50.0, end_us) if previous <= turn < now]
            lines += heard(now, "passing", sent) + heard(now, "held", sent)
        return lines

    # Before the reset the readers had their last turn at 252 ms, the senders had theirs at 260 and 280 ms.
    expected = [*heard_until(290_000), "0 reset", *heard(0, "held", [260_000, 280_000]), *heard_until(200_000)]
    assert graph.transcript("r_cpp") == expected
    assert graph.transcript("r_py") == expected


def test_unreachable_machine_is_detected_within_seconds(graph: MixedGraph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(unix_sockets, "listen", lambda *_: None)  # TCP, as between machines
    server = LockstepServer()
    graph.set_param("/lockstep/uri", server.uri)
    graph.start_cpp("participant", "a", "50", "0", "a")
    assert server.wait_for(["/a"], timeout=PATIENCE)
    ports = [int(end.rpartition(":")[2]) for end in (server.participants["/a"].address, server.uri)]
    timers: list[float] = []

    def keepalive_runs() -> bool:
        timers[:] = keepalive_timers(*ports)
        return bool(timers)  # while sent data is unacknowledged, the kernel reports another timer

    wait_until(keepalive_runs, "the node's keep-alive timer runs")
    assert len(timers) == 1
    assert timers[0] <= 3.0
    server.close()


def keepalive_timers(local: int, remote: int) -> list[float]:
    """Return the times (s) after which the kernel probes a TCP connection; empty without keepalive.

    Args:
        local: Local port.
        remote: Remote port.
    """
    ends = [f"{local:04X}", f"{remote:04X}"]
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    timers = [row[5].split(":") for row in rows if [end.split(":")[1] for end in row[1:3]] == ends]
    return [int(left, 16) / os.sysconf("SC_CLK_TCK") for kind, left in timers if kind == "02"]


def test_digests_follow_the_protocol(graph: MixedGraph) -> None:
    digests: list[tuple[str, int, dict[str, list[int]]]] = []
    server = LockstepServer(on_digest=lambda name, time_us, topics: digests.append((name, time_us, dict(topics))))
    graph.set_param("/lockstep/uri", server.uri)
    graph.start_cpp("stamper", "stamper")
    graph.start("stamper", "py_stamper")
    graph.start_cpp("participant", "a", "50", "0", "a")
    assert server.wait_for(["/a", "/stamper", "/py_stamper"], timeout=PATIENCE)
    now = run(server, 1_030_000)
    for name in ("a", "stamper", "py_stamper"):
        graph.processes[name].send_signal(signal.SIGINT)
        graph.ended(name)
    end = time.monotonic() + PATIENCE
    while server.participants and time.monotonic() < end:
        server.poll(0.1)
    server.close()
    times = due_times(50.0, now)
    stamps, words = Digest(), Digest()
    for seq, turn in enumerate(times, start=1):
        message = PointStamped(header=Header(seq, rospy.Time(*divmod(turn * 1000, 10**9)), "map"))
        stamps.add(turn, serialised(message))
    heard = [line.split(maxsplit=2)[2] for line in graph.transcript("a") if line.split()[1] == "a"]
    for text in heard:
        words.add(int(text.split()[0]), serialised(String(text)))
    assert [time_us for name, time_us, _ in digests if name == "/stamper"] == [0, 1_000_000, times[-1]]
    assert last_digests(digests, "/stamper") == {"/stamps": stamps.state()}
    assert last_digests(digests, "/py_stamper") == {"/stamps": stamps.state()}
    # Its last messages had no receiver.
    last = last_digests(digests, "/a")
    assert last["/from_a"] == last["/shared"]
    assert last["/from_a"][0] == words.messages + 1
    second = next(topics for name, time_us, topics in digests if name == "/a" and time_us == 1_000_000)
    early = Digest()
    for text in heard[: times.index(1_000_000) + 1]:
        early.add(int(text.split()[0]), serialised(String(text)))
    assert second["/from_a"] == early.state()


def serialised(message: object) -> bytes:
    from io import BytesIO

    buffer = BytesIO()
    message.serialize(buffer)  # type: ignore[attr-defined]
    return buffer.getvalue()


def last_digests(digests: list[tuple[str, int, dict[str, list[int]]]], name: str) -> dict[str, list[int]]:
    return [topics for sender, _, topics in digests if sender == name][-1]


def test_without_a_simulator_the_node_is_an_ordinary_node(graph: MixedGraph) -> None:
    graph.start_cpp("alone", "alone")
    assert "alone is well" in graph.ended("alone")


def test_the_private_parameter_opts_out(graph: MixedGraph, server: LockstepServer) -> None:
    graph.set_param("/alone/lockstep", False)
    graph.start_cpp("alone", "alone")
    assert "alone is well" in graph.ended("alone")
    assert not server.participants


def test_node_started_first_waits_for_the_simulator(graph: MixedGraph) -> None:
    graph.set_param("/lockstep/wait", True)
    graph.start_cpp("participant", "a", "50", "0", "a")

    def there() -> bool:
        return any("/a" in nodes for _, nodes in graph.master.getSystemState("/t")[2][0])

    wait_until(there, "the node registers")
    server = LockstepServer()
    graph.set_param("/lockstep/uri", server.uri)
    assert server.wait_for(["/a"], timeout=PATIENCE)
    run(server, 100_000)
    assert list(server.participants) == ["/a"]
    server.close()


def test_missing_master_is_reported(graph: MixedGraph) -> None:
    graph.ros_master.close()
    assert graph.start_cpp("alone", "alone").wait(PATIENCE) == 1
    assert f"no ROS master answers at {graph.env['ROS_MASTER_URI']}" in graph.output("alone")


@pytest.mark.parametrize("program", ["lockstep_idle", "lockstep_idle.py"])
def test_idle_participant_gets_every_turn(graph: MixedGraph, server: LockstepServer, program: str) -> None:
    path = Path(str(NODE)).with_name(program)
    graph.processes["idle"] = graph._popen("idle", [str(path), "idle_1", "125"])
    assert server.wait_for(["/idle_1"], timeout=PATIENCE)
    assert server.participants["/idle_1"].rate == 125.0
    run(server, 200_000)
    assert list(server.participants) == ["/idle_1"]
    server.close()
    graph.ended("idle")


@pytest.mark.parametrize("program", ["lockstep_idle", "lockstep_idle.py"])
@pytest.mark.parametrize("arguments", [["idle"], ["idle", "fast"], ["idle", "1000"]])
def test_idle_participant_requires_a_name_and_a_rate(graph: MixedGraph, program: str, arguments: list[str]) -> None:
    command = [str(Path(str(NODE)).with_name(program)), *arguments]
    done = subprocess.run(command, env=graph.env, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 2
    assert "usage" in done.stderr


if __name__ == "__main__":
    role, name, *rest = sys.argv[1:]
    if role == "participant":
        participant(name, float(rest[0]), int(rest[1]), rest[2:])
    else:
        {
            function.__name__: function
            for function in (heavy, stamper, sender, reader, talker, listener, clock, rewinder)
        }[role](name, *rest)
