"""The keyboard at a pseudo-terminal, with a real master: the terminal before and after, topics, and a flight."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import math
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading
import xmlrpc.client
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import REPOSITORY, START_LIMIT, WALL_LIMIT, Graph, Stack, free_port, poll

pytest.importorskip("rospy")

import rosgraph
import rospy
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from mavros_msgs.msg import PositionTarget
from std_msgs.msg import String
from std_srvs.srv import Trigger

from xtdrone_coordination.patterns import Patterns

PROGRAM = str(REPOSITORY / "src" / "xtdrone_interaction" / "nodes" / "multirotor_keyboard_control.py")
READY = "Ctrl-C ends"  # the last line of the table on the screen
LONG = 1000.0  # s of simulated time in which a key takes effect; ten pass in a second of wall time
_ESCAPES = re.compile(r"\x1b(?:\[[0-9;?]*[a-zA-Z]|[()][0-9A-B]|[=>78])")

BROKEN = """
import sys
from xtdrone_interaction.keyboard import keyboard_node
def press(self, key):
    raise RuntimeError("a fault of the keyboard's own")
keyboard_node.Pilot.press = press
sys.exit(keyboard_node.main())
"""


def _sit_down() -> None:
    """Make the terminal the child's controlling one, and restore SIGHUP, which nohup may have disabled."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


class Seat:
    """A program at its own terminal, as started by a shell.

    Attributes:
        process: the program.
        before: the terminal's settings before it started.
    """

    def __init__(self, graph: Graph, *command: str, term: str = "xterm", columns: int = 80, rows: int = 30) -> None:
        self._master, self._slave = pty.openpty()
        fcntl.ioctl(self._slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.before = self.settings()
        self._written = bytearray()
        self._hung_up = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        environment = {**os.environ, **graph.environment, "TERM": term}
        self.process = subprocess.Popen(
            [sys.executable, *command], stdin=self._slave, stdout=self._slave, stderr=self._slave, env=environment,
            start_new_session=True, preexec_fn=_sit_down,
        )  # fmt: skip

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while not self._hung_up and (data := os.read(self._master, 4096)):
                self._written += data

    def settings(self) -> list[Any]:
        """Return the settings of the terminal."""
        return termios.tcgetattr(self._slave)

    @property
    def raw(self) -> str:
        return self._written.decode(errors="replace")

    @property
    def text(self) -> str:
        """The output without cursor control."""
        return _ESCAPES.sub("\n", self.raw)

    def see(self, *words: str, since: int = 0) -> None:
        """Wait until these words are in the output."""

        def seen() -> bool:
            assert self.process.poll() is None, self.text
            return all(word in self.text[since:] for word in words)

        try:
            poll(seen, f"the terminal shows {words}", START_LIMIT)
        except AssertionError as error:
            raise AssertionError(f"{error}; it shows {self.text[-1500:]!r}") from None

    def type(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def state(self) -> str:
        """Return the process's state in /proc: T is stopped."""
        return Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()[0]

    def hang_up(self) -> None:
        """Close the terminal's other end, like a closed window or a lost ssh connection."""
        self._hung_up = True
        self.type("h")  # the key wakes the reader
        self._reader.join()
        os.close(self._master)

    def end(self) -> int:
        return self.process.wait(WALL_LIMIT)

    def leave(self) -> None:
        """Release everything."""
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        for descriptor in (self._slave, *([] if self._hung_up else [self._master])):
            os.close(descriptor)


@pytest.fixture
def sit(graph: Graph) -> Iterator[Callable[..., Seat]]:
    """Start the keyboard, or another program, at a terminal; /use_sim_time is set and no clock runs."""
    graph.forget()
    rospy.set_param("/use_sim_time", True)
    seats = []

    def start(*arguments: str, **options: Any) -> Seat:
        seats.append(Seat(graph, *(arguments if arguments[0] == "-c" else (PROGRAM, *arguments)), **options))
        return seats[-1]

    yield start
    for seat in seats:
        seat.leave()
    graph.forget()


def taken(seat: Seat) -> bool:
    """Return whether keys arrive one by one and without echo."""
    return not seat.settings()[3] & (termios.ICANON | termios.ECHO)


# ---- the terminal is restored


def shutdown_by_master(seat: Seat) -> None:
    """Shut the node down as ``rosnode kill`` does."""
    uri = rosgraph.Master("/system_tests").lookupNode("/multirotor_keyboard_control")
    with contextlib.suppress(OSError):  # it may end before it has replied
        xmlrpc.client.ServerProxy(uri).shutdown("/system_tests", "a test")


ENDINGS: dict[str, tuple[Callable[[Seat], Any], int, str]] = {
    "Ctrl-C": (lambda seat: seat.type("\x03"), 0, ""),
    "SIGTERM": (lambda seat: seat.process.terminate(), 0, ""),
    "SIGHUP": (lambda seat: seat.process.send_signal(signal.SIGHUP), 0, ""),
    "Ctrl-\\": (lambda seat: seat.type("\x1c"), 0, ""),  # SIGQUIT
    "rosnode kill": (shutdown_by_master, 0, "the node was requested to end"),
    "an exception": (lambda seat: seat.type("t"), 1, "a fault of the keyboard's own"),
}


@pytest.mark.timeout(2 * START_LIMIT)
@pytest.mark.parametrize("ending", list(ENDINGS))
def test_the_terminal_is_restored(graph: Graph, sit: Callable[..., Seat], ending: str) -> None:
    speeds = graph.hear("/xtdrone/iris_0/cmd_vel_flu", Twist)
    seat = sit("-c", BROKEN, "iris", "1", "vel") if ending == "an exception" else sit("iris", "1", "vel")
    seat.see(READY)
    assert taken(seat)
    if ending != "an exception":
        poll(lambda: heard("/xtdrone/iris_0/cmd_vel_flu"), "the keyboard publishes to us")
        seat.type("www")
        poll(lambda: speeds.last and speeds.last.linear.x == 0.03, "the speed is told")
    act, status, word = ENDINGS[ending]
    act(seat)
    assert seat.end() == status
    poll(lambda: seat.settings() == seat.before, "the terminal is as it was")
    poll(lambda: "\x1b[?1049l" in seat.raw, "the screen is the one that was before")
    assert word in seat.text
    if ending != "an exception":
        poll(lambda: speeds.last.linear.x == 0.0, "the vehicle was told to keep still")


@pytest.mark.timeout(2 * START_LIMIT)
def test_a_terminal_that_goes_ends_it_and_stops_the_vehicles(graph: Graph, sit: Callable[..., Seat]) -> None:
    speeds = graph.hear("/xtdrone/iris_0/cmd_vel_flu", Twist)
    seat = sit("iris", "1", "vel")
    seat.see(READY)
    poll(lambda: heard("/xtdrone/iris_0/cmd_vel_flu"), "the keyboard publishes to us")
    seat.type("www")
    poll(lambda: speeds.last and speeds.last.linear.x == 0.03, "the speed is told")
    seat.hang_up()
    assert seat.end() in (0, 1)  # SIGHUP, or the end of input where that is seen first
    poll(lambda: speeds.last == Twist(), "the vehicle was told to keep still")


def heard(topic: str) -> bool:
    """Return whether a subscriber is connected to the keyboard's topic; before that, the keyboard may report none."""
    uri = rosgraph.Master("/system_tests").lookupNode("/multirotor_keyboard_control")
    _, _, connections = xmlrpc.client.ServerProxy(uri).getBusInfo("/system_tests")
    return any(entry[2] == "o" and entry[4] == topic and entry[5] for entry in connections)


@pytest.mark.timeout(2 * START_LIMIT)
def test_stopped_and_continued_and_every_key_counts(graph: Graph, sit: Callable[..., Seat]) -> None:
    """Ctrl-Z restores the terminal and ``fg`` takes it again; keys of leader and patterns still take effect."""
    speeds = graph.hear("/xtdrone/iris_0/cmd_vel_flu", Twist)
    commands = graph.hear("/xtdrone/iris_1/cmd", String)
    leader = graph.hear("/xtdrone/leader/cmd", String)
    leader_speeds = graph.hear("/xtdrone/leader/cmd_vel_flu", Twist)
    seat = sit("iris", "9", "vel")
    seat.see(READY, "iris_8")
    for topic in ("iris_0/cmd_vel_flu", "iris_1/cmd", "leader/cmd", "leader/cmd_vel_flu"):
        poll(lambda topic=topic: heard(f"/xtdrone/{topic}"), "the keyboard publishes to us")
    seat.type("w" * 50 + "l\x1b[15~")
    poll(lambda: speeds.last and (speeds.last.linear.x, speeds.last.angular.z) == (0.5, -0.01), "all keys count")
    seat.type("\x1a")
    poll(lambda: seat.state() == "T", "it is stopped")
    assert seat.settings() == seat.before
    poll(lambda: speeds.last == Twist(), "the vehicle keeps still meanwhile")
    seen = len(seat.text)
    seat.process.send_signal(signal.SIGCONT)
    seat.see("forward +0.00", "iris_8", since=seen)
    assert taken(seat)

    seat.type("t")
    poll(lambda: commands.last and commands.last.data == "ARM", "a command is told")
    seat.type("1g2w7")
    poll(lambda: leader.last and leader.last.data == "origin", "the leader is told")
    assert [message.data for message in leader.messages] == ["pyramid", "origin"]
    poll(lambda: leader_speeds.last and leader_speeds.last.linear.x == 0.01, "the leader is steered")
    assert [message.data for message in commands.messages] == ["ARM"], "a pattern is no mode of a vehicle"
    seen = len(seat.text)
    seat.type("9")
    seat.see("there is no such pattern", since=seen)
    seat.type("\x03")
    assert seat.end() == 0
    assert seat.settings() == seat.before
    poll(lambda: leader_speeds.last == Twist(), "the leader was told to keep still")


@pytest.mark.timeout(2 * START_LIMIT)
def test_a_dumb_terminal_gets_lines(sit: Callable[..., Seat]) -> None:
    seat = sit("iris:2,solo:1", "accel", term="dumb")
    seat.see("iris 2, solo 1, accel", "w/x forward/back")
    seat.type("www")
    seat.see("forward +0.03")
    seat.type("t")
    seat.see("ARM to all", "no communication node")
    seat.see("solo_0: arming unknown")
    assert "\x1b" not in seat.raw
    seat.process.terminate()
    assert seat.end() == 0
    assert seat.settings() == seat.before


@pytest.mark.timeout(2 * START_LIMIT)
def test_a_lost_and_a_new_master_are_reported(
    graph: Graph, sit: Callable[..., Seat], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    port = free_port()
    environment = {**graph.environment, "ROS_MASTER_URI": f"http://127.0.0.1:{port}"}
    masters = []

    def start_master() -> None:
        with (tmp_path / f"master_{len(masters)}.log").open("wb") as log:
            command = ["rosmaster", "--core", "-p", str(port)]
            output = {"stdout": log, "stderr": log}
            masters.append(subprocess.Popen(command, env={**os.environ, **environment}, **output))
        poll(rosgraph.Master("/system_tests", f"http://127.0.0.1:{port}").is_online, "the master answers")

    try:
        start_master()
        monkeypatch.setattr(graph, "environment", environment)
        seat = sit("iris", "1")
        seat.see(READY)
        masters[0].kill()
        seat.see("no ROS master")
        start_master()
        seat.see("a new ROS master: end this, start it again")
        seat.type("\x03")
        assert seat.end() == 0
        assert seat.settings() == seat.before
    finally:
        for master in masters:
            master.kill()
            master.wait()


# ---- bad values


def test_without_a_terminal_nothing_is_done(graph: Graph) -> None:
    environment = {**os.environ, **graph.environment}
    done = subprocess.run(
        [sys.executable, PROGRAM, "iris", "1"], input="t", capture_output=True, text=True, env=environment, timeout=120
    )
    assert done.returncode == 2
    assert "not a terminal" in done.stderr
    assert "multirotor_keyboard_control" not in str(rosgraph.Master("/system_tests").getSystemState())


@pytest.mark.parametrize(
    ("arguments", "environment", "status", "word"),
    [
        (["iris", "0", "vel"], {}, 2, "1 to 250"),
        (["iris", "1", "vel"], {"ROS_MASTER_URI": "http://127.0.0.1:1"}, 1, "no ROS master"),
    ],
)
def test_a_failed_start_has_a_reason(
    graph: Graph,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    environment: dict[str, str],
    status: int,
    word: str,
) -> None:
    monkeypatch.setattr(graph, "environment", {**graph.environment, **environment})
    seat = Seat(graph, PROGRAM, *arguments)
    try:
        assert seat.end() == status
        poll(lambda: word in seat.text, "it says why")
        assert seat.settings() == seat.before
    finally:
        seat.leave()


# ---- a flight


@pytest.mark.timeout(3 * START_LIMIT)
def test_keys_reach_the_vehicles(graph: Graph, sit: Callable[..., Seat], tmp_path: Path) -> None:
    """Takeoff as documented by XTDrone, a single press, hover, landing and takeoff by mode work, also while paused."""
    stack = Stack(graph, tmp_path, "iris:2")
    both = range(2)
    poses = [graph.hear(f"/iris_{i}/mavros/local_position/pose", PoseStamped) for i in both]
    targets = [graph.hear(f"/iris_{i}/mavros/setpoint_raw/local", PositionTarget) for i in both]

    def place(index: int) -> tuple[float, float, float]:
        p = poses[index].last.pose.position
        return p.x, p.y, p.z

    def wait(condition: Callable[[], Any], what: str) -> None:
        stack.wait(condition, what, sim=LONG)

    def wait_modes(mode: str) -> None:
        for index in both:
            stack.wait_state(index, mode=mode, sim=LONG)

    def wait_hover() -> None:
        """Wait until both have a position setpoint and have come to rest; they must stay there."""
        wait(lambda: all(not ear.last.type_mask & PositionTarget.IGNORE_PX for ear in targets), "both are to hover")
        stack.pass_time(5.0)
        before = [place(i) for i in both]
        stack.pass_time(5.0)
        assert all(math.dist(place(i), before[i]) < 0.02 for i in both)

    try:
        parameters = ["_speed:=10", "_participants:=communication"]
        stack.run("simulator", "xtdrone_swarm", "simplified_simulator", "iris", "2", *parameters)
        master = rosgraph.Master("/system_tests")
        poll(lambda: master.hasParam("/lockstep/uri"), "the simulator offers its lockstep", START_LIMIT)
        stack.run("communication", "xtdrone_control", "multirotor_communication.py", "iris", "0-1")
        stack.wait(lambda: all(ear.last for ear in (*poses, *targets)), "both say how they are", wall=START_LIMIT)
        seat = sit("iris", "2", "vel")
        seat.see("iris_1", "disarmed", "AUTO.LOITER", "0.00 m/s")
        for topic in ("cmd", "cmd_vel_flu"):
            poll(lambda topic=topic: all(heard(f"/xtdrone/iris_{i}/{topic}") for i in both), "both hear the keyboard")

        seat.type("i" * 35 + "b")
        wait_modes("OFFBOARD")
        seat.type("t")
        wait(lambda: all(place(i)[2] > 2.0 for i in both), "both climb")
        seat.type("s")
        wait_hover()
        shown = r"iris_1 +armed +OFFBOARD +(\d+\.\d\d) m +0\.0\d m/s"
        height = place(1)[2]
        poll(
            lambda: any(abs(float(seen) - height) < 0.05 for seen in re.findall(shown, seat.text)),
            f"the screen shows iris_1 at rest at {height:.2f} m",
        )

        before = [place(i) for i in both]
        seat.type("w")  # 0.01 m/s; vehicles face east
        wait(lambda: all(place(i)[0] - before[i][0] > 0.1 for i in both), "a press moves both")
        assert all(abs(place(i)[1] - before[i][1]) < 0.02 for i in both)
        assert all(ear.last.velocity.x == 0.01 for ear in targets)
        seat.type("x")
        wait_hover()

        seat.type("n")
        for index in both:
            stack.wait_landed(index, sim=LONG)
        seat.type("v")
        wait_modes("AUTO.TAKEOFF")
        seat.type("t")
        wait(lambda: all(place(i)[2] > 1.5 for i in both), "both take off")

        assert graph.call("/simulator/pause", Trigger).success
        seat.see("silent for")
        seen = len(seat.text)
        seat.type("n")
        seat.see("AUTO.LAND to all", since=seen)
        assert graph.call("/simulator/resume", Trigger).success
        for index in both:
            stack.wait_landed(index, sim=LONG)
        seat.type("\x03")
        assert seat.end() == 0
        assert seat.settings() == seat.before
    finally:
        stack.stop()


@pytest.mark.timeout(3 * START_LIMIT)
def test_the_leader_is_steered_by_accelerations_and_others_follow(
    graph: Graph, sit: Callable[..., Seat], tmp_path: Path
) -> None:
    """Leader and followers fly a pattern by its digit, speed up and come to rest, from a start in the air."""
    count = 3
    stack = Stack(graph, tmp_path, f"solo:{count}")
    poses = [graph.hear(f"/solo_{i}/mavros/local_position/pose", PoseStamped) for i in range(count)]
    velocity = graph.hear("/solo_0/mavros/local_position/velocity_local", TwistStamped)
    slots = Patterns(count).offsets("circle").tolist()

    def place(index: int) -> tuple[float, float, float]:
        p = poses[index].last.pose.position
        return p.x, p.y, p.z

    def in_formation() -> bool:
        leader, *others = (place(i) for i in range(count))
        relative = [[a - b for a, b in zip(other, leader, strict=True)] for other in others]
        return any(
            all(math.dist(a, b) < 0.1 for a, b in zip(relative, order, strict=True))
            for order in itertools.permutations(slots)
        )

    try:
        options = ["_airborne:=true", "_speed:=10", "_participants:=leader,followers"]
        stack.run("simulator", "xtdrone_swarm", "simplified_simulator", "solo", str(count), *options)
        master = rosgraph.Master("/system_tests")
        poll(lambda: master.hasParam("/lockstep/uri"), "the simulator offers its lockstep", START_LIMIT)
        stack.run("leader", "xtdrone_coordination", "leader.py", "solo", str(count))
        stack.run("followers", "xtdrone_coordination", "follower_consensus.py", "solo", "1-2", str(count), "vel")
        stack.wait(lambda: all(ear.last for ear in (*poses, velocity)), "all say where they are", wall=START_LIMIT)
        seat = sit("solo", str(count), "accel")
        seat.see("solo_2", "armed", "OFFBOARD", "circle")
        for topic in ("cmd", "cmd_accel_flu"):
            poll(lambda topic=topic: heard(f"/xtdrone/leader/{topic}"), "the leader hears the keyboard")

        digit = re.search(r"(\d)\s+circle", seat.text)
        assert digit
        seat.type(f"g{digit[1]}")
        stack.wait(in_formation, "they fly a circle", sim=LONG)
        start = place(0)
        seat.type("w" * 20)  # 0.2 m/s^2; vehicles face east
        stack.wait(lambda: velocity.last.twist.linear.x > 0.8, "the leader gets faster and faster", sim=LONG)
        assert not in_formation(), "the others lag behind"
        seat.type("s")
        stack.wait(lambda: abs(velocity.last.twist.linear.x) < 0.01, "the leader comes to rest", sim=LONG)
        stack.wait(in_formation, "the others come after", sim=LONG)
        moved = [a - b for a, b in zip(place(0), start, strict=True)]
        assert moved[0] > 1.0
        assert max(map(abs, moved[1:])) < 0.1
        seat.type("\x03")
        assert seat.end() == 0
    finally:
        stack.stop()
