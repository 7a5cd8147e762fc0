"""Shared by the system tests: a ROS master, programs of the workspace, this process's subscriptions and publishers.

A test waits for events (a message, a line in a log, a process's end) and measures limits in simulated time; wall time
only bounds how long a broken run may take.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from xtdrone_common.fleet import parse_fleet
from xtdrone_interaction.command_options import OptionError, check_vehicle_ports
from xtdrone_interaction.launching.process_tree import ProcessTree

REPOSITORY = Path(__file__).resolve().parents[1]
FLEET = "iris:2"
WALL_LIMIT = 120.0  # s; longest wait for anything, on a busy machine
START_LIMIT = 200.0  # s; longest start of a simulator, with kernels still to be compiled
_PORTS_LIMIT = 240.0  # s of wall time for another simulation on this machine to end
_SLICE = 0.05  # s between polls of logs and processes, which send no message
_MASTERS_OWN = {"rosdistro", "roslaunch", "rosversion", "run_id"}  # parameters that roscore sets
os.environ.pop("DISPLAY", None)  # no simulator opens its window on the tester's screen
_TAG = "XTDRONE_TEST_STACK"  # environment variable by which a stack's processes are found


def built() -> bool:
    """Return whether roslaunch and the workspace's packages exist."""
    if shutil.which("roslaunch") is None:
        return False
    import rospkg

    return {"xtdrone_sim", "xtdrone_coordination"} <= set(rospkg.RosPack().list())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests that need the built workspace where there is none."""
    if built():
        return
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.skip(reason="the workspace is not built and sourced"))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def poll(condition: Callable[[], Any], what: str, limit: float = WALL_LIMIT) -> Any:
    """Return the first true value of ``condition``, which no message announces; fail after ``limit`` s of wall time."""
    end = time.monotonic() + limit
    while not (value := condition()):
        assert time.monotonic() < end, f"{what}: not within {limit:g} s"
        time.sleep(_SLICE)
    return value


def _listens(uri: str) -> bool:
    """Return whether a node's process listens; the master also names nodes that were killed."""
    address = urlsplit(uri)
    try:
        with socket.create_connection((address.hostname, address.port)):
            return True
    except OSError:
        return False


class Ear:
    """A subscription that keeps every message.

    Attributes:
        topic: the topic's name.
        messages: all so far.
    """

    def __init__(self, graph: Graph, topic: str, kind: type, queue_size: int | None = None) -> None:
        import rospy

        self.topic = topic
        self.messages: list[Any] = []
        self._graph = graph
        self._subscriber = rospy.Subscriber(topic, kind, self._take, queue_size=queue_size, tcp_nodelay=True)

    @property
    def last(self) -> Any:
        """The newest message, None before the first."""
        return self.messages[-1] if self.messages else None

    def is_connected(self) -> bool:
        """Return whether a publisher's messages arrive."""
        return self._subscriber.get_num_connections() > 0

    def since(self, count: int) -> list[Any]:
        """Return all messages after the first ``count``."""
        return self.messages[count:]

    def _take(self, message: Any) -> None:
        with self._graph.changed:
            self.messages.append(message)
            self._graph.changed.notify_all()

    def close(self) -> None:
        self._subscriber.unregister()


class Graph:
    """A ROS master for the tests, and this process as a plain node on it.

    Attributes:
        uri: the master's.
        changed: notified with every message.
    """

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.folder = folder
        self.changed = threading.Condition()
        self._ears: dict[str, Ear] = {}
        self._mouths: dict[str, Any] = {}
        self.environment = {
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            "ROS_LOG_DIR": str(folder / "ros"),
            "PYTHONUNBUFFERED": "1",
        }
        environment = {**os.environ, **self.environment}
        self._master = ProcessTree(["roscore", "-p", str(self.port)], environment, folder / "roscore.log")

    def open(self) -> None:
        """Join the master as a node; ``os.environ`` must name it."""
        import rosgraph
        import rospy

        poll(rosgraph.is_master_online, "the master answers")
        rospy.init_node("system_tests", disable_signals=True)

    def hear(self, topic: str, kind: type, queue_size: int | None = None) -> Ear:
        """Return the subscription to a topic, which is connected if a running node publishes the topic.

        Else a simulation, which may run a hundred times as fast as time, would be far ahead of the first message.
        """
        if topic not in self._ears:
            self._ears[topic] = Ear(self, topic, kind, queue_size)
            if self._is_published(topic):
                poll(self._ears[topic].is_connected, f"{topic} is connected")
        return self._ears[topic]

    def _is_published(self, topic: str) -> bool:
        import rosgraph

        master = rosgraph.Master("/system_tests")
        for name in dict(master.getSystemState()[0]).get(topic, []):
            with contextlib.suppress(rosgraph.MasterError):  # it has unregistered since
                if _listens(master.lookupNode(name)):
                    return True
        return False

    def say(self, topic: str, message: Any) -> None:
        """Publish a message as soon as there is a subscriber."""
        import rospy

        if topic not in self._mouths:
            self._mouths[topic] = rospy.Publisher(topic, type(message), queue_size=100, tcp_nodelay=True)
        mouth = self._mouths[topic]
        poll(mouth.get_num_connections, f"a subscriber of {topic}")
        mouth.publish(message)

    def say_latched(self, topic: str, message: Any) -> None:
        """Publish a message to present and future subscribers."""
        import rospy

        if topic not in self._mouths:
            self._mouths[topic] = rospy.Publisher(topic, type(message), queue_size=1, latch=True)
        self._mouths[topic].publish(message)

    def call(self, service: str, kind: type, **fields: Any) -> Any:
        """Call a service and return its response."""
        import rospy

        rospy.wait_for_service(service, WALL_LIMIT)
        return rospy.ServiceProxy(service, kind)(**fields)

    def forget(self) -> None:
        """Close all subscriptions and publishers, and delete all parameters from the master."""
        for entry in (*self._ears.values(), *self._mouths.values()):
            entry.close() if isinstance(entry, Ear) else entry.unregister()
        self._ears.clear()
        self._mouths.clear()
        self.forget_parameters()

    def forget_parameters(self) -> None:
        """Delete the parameters of nodes from the master; later nodes of the same names would inherit them."""
        import rosgraph

        master = rosgraph.Master("/system_tests")
        for name in master.getParam("/"):
            if name not in _MASTERS_OWN:
                master.deleteParam(f"/{name}")

    def close(self) -> None:
        import rospy

        rospy.signal_shutdown("the tests have ended")
        self._master.process.send_signal(signal.SIGINT)
        self._master.wait(WALL_LIMIT)


def _kind(name: str) -> type:
    import roslib.message

    kind = roslib.message.get_message_class(name)
    assert kind is not None, name
    return kind


class Program:
    """A program of the workspace, started as by ``rosrun``."""

    def __init__(self, stack: Stack, name: str, arguments: Sequence[str]) -> None:
        self.name = name
        self.log = stack.folder / f"{name}.log"
        environment = {**os.environ, **stack.graph.environment, _TAG: stack.tag}
        with self.log.open("wb") as output:
            self.process = subprocess.Popen(
                arguments, env=environment, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
            )

    @property
    def output(self) -> str:
        """The output so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def kill(self) -> None:
        """Kill the program, as ``kill -9`` does."""
        self.process.kill()
        self.process.wait()

    def end(self, limit: float = WALL_LIMIT) -> int:
        """Wait for the program's end and return the exit status."""
        try:
            return self.process.wait(limit)
        except subprocess.TimeoutExpired:
            pytest.fail(f"{self.name} has not ended within {limit:g} s:\n{self.output[-3000:]}")


class Safety:
    """The extremes of the true motion, from /gazebo/model_states.

    Attributes:
        sink: greatest speed downwards, m/s, by vehicle.
        tilt: greatest angle between the vehicle's and the world's up, rad, by vehicle.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self.reset()

    def reset(self) -> None:
        self.sink = dict.fromkeys(self.names, 0.0)
        self.tilt = dict.fromkeys(self.names, 0.0)

    def see(self, states: Any) -> None:
        for name, pose, twist in zip(states.name, states.pose, states.twist, strict=True):
            if name in self.sink:
                q = pose.orientation
                up = 1.0 - 2.0 * (q.x * q.x + q.y * q.y)
                self.tilt[name] = max(self.tilt[name], math.acos(max(-1.0, min(1.0, up))))
                self.sink[name] = max(self.sink[name], -twist.linear.z)


class Stack:
    """A running system: programs, their output and their topics.

    Attributes:
        graph: master and topics.
        folder: logs.
        programs: by name.
        safety: the extremes of motion so far.
    """

    def __init__(self, graph: Graph, folder: Path, fleet: str = FLEET) -> None:
        self.graph = graph
        self.folder = folder
        self.tag = uuid.uuid4().hex
        self.programs: dict[str, Program] = {}
        self.vehicles = parse_fleet(fleet)
        self.safety = Safety([vehicle.name for vehicle in self.vehicles])
        self._states = graph.hear("/gazebo/model_states", _kind("gazebo_msgs/ModelStates"))
        self._seen = 0
        # high rate at full speed, and only the newest counts
        self._clock = graph.hear("/clock", _kind("rosgraph_msgs/Clock"), queue_size=1)

    # processes

    def run(self, name: str, package: str, program: str, *arguments: str) -> Program:
        """Start a node; ``name`` is its node name."""
        path = REPOSITORY / "src" / package / "nodes" / program
        return self.start(name, [sys.executable, str(path), *arguments, f"__name:={name}"])

    def launch(self, file: str, *arguments: str) -> Program:
        """Start roslaunch with a file of launch/."""
        return self.start("roslaunch", ["roslaunch", str(REPOSITORY / "launch" / file), *arguments])

    def start(self, name: str, command: list[str]) -> Program:
        """Start any program."""
        program = self.programs[name] = Program(self, name, command)
        return program

    def processes(self) -> dict[int, str]:
        """Return id and command line of every process of this stack, roslaunch's nodes too."""
        found = {}
        for entry in Path("/proc").iterdir():
            if not entry.name.isdigit():
                continue
            try:
                if f"{_TAG}={self.tag}".encode() in (entry / "environ").read_bytes():
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:  # it has ended, or belongs to another user
                continue
        return found

    def pid(self, program: str) -> int:
        """Return the id of roslaunch's node that runs ``program``."""
        found = [pid for pid, command in self.processes().items() if f"/{program} " in command]
        assert len(found) == 1, (program, self.processes())
        return found[0]

    def stop(self) -> None:
        """End all programs; kill those that do not end on request."""
        for program in self.programs.values():
            if program.alive:
                program.process.send_signal(signal.SIGINT)
        end = time.monotonic() + 15.0
        while self.processes() and time.monotonic() < end:
            for program in self.programs.values():
                program.process.poll()
            time.sleep(_SLICE)
        for pid in self.processes():
            with contextlib.suppress(ProcessLookupError):  # it has ended since
                os.kill(pid, signal.SIGKILL)
        for program in self.programs.values():
            program.process.wait()

    # time and events

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self._clock.last.clock.to_sec() if self._clock.last else 0.0

    def wait(self, condition: Callable[[], Any], what: str, sim: float = 30.0, wall: float = WALL_LIMIT) -> Any:
        """Return the first true value of ``condition``.

        Args:
            condition: evaluated whenever a message arrives.
            what: description for the failure.
            sim: limit of simulated time, s.
            wall: limit of wall time, s, for a simulation that stands still.
        """
        begin, end = math.nan, time.monotonic() + wall
        with self.graph.changed:
            while True:
                self._look()
                if value := condition():
                    return value
                if math.isnan(begin):  # only now: the condition may have subscribed to a topic
                    begin = self.time
                waited = self.time - begin
                assert waited <= sim, f"{what}: not within {sim:g} s of simulated time; {self.described()}"
                assert time.monotonic() < end, f"{what}: not within {wall:g} s of wall time; {self.described()}"
                self.graph.changed.wait(_SLICE)

    def pass_time(self, seconds: float) -> None:
        """Advance simulated time."""
        until = self.time + seconds
        self.wait(lambda: self.time >= until, f"{seconds:g} s pass", sim=seconds + 5.0)

    def log_has(self, program: str, *texts: str, since: int = 0) -> None:
        """Wait until ``program`` has written all ``texts`` (in characters after ``since``)."""
        log = self.programs[program]
        poll(
            lambda: all(text in log.output[since:] for text in texts),
            f"{program} writes {texts}; it wrote {log.output[since:][-2000:]!r}",
        )

    def described(self) -> str:
        """Return the known state, for a failure message."""
        ended = {name: p.process.returncode for name, p in self.programs.items() if not p.alive}
        tails = {name: p.output[-3000:] for name, p in self.programs.items()}
        return f"time {self.time:.2f} s, ended {ended}, last words {tails}"

    # vehicles

    def _look(self) -> None:
        for states in self._states.since(self._seen):
            self.safety.see(states)
        self._seen = len(self._states.messages)

    @property
    def states(self) -> Any:
        """The newest true states of all models (gazebo_msgs/ModelStates), None before the first."""
        return self._states.last

    def pose(self, index: int) -> Any:
        """Return the true pose, None before the first."""
        states, name = self._states.last, self.vehicles[index].name
        return states.pose[states.name.index(name)] if states and name in states.name else None

    def height(self, index: int) -> float:
        """Return the true height above the ground, m."""
        pose = self.pose(index)
        return pose.position.z if pose else 0.0

    def state(self, index: int) -> Any:
        """Return the newest mavros/state, None before the first."""
        return self.graph.hear(f"/{self.vehicles[index].name}/mavros/state", _kind("mavros_msgs/State")).last

    def wait_state(self, index: int, *, mode: str | None = None, armed: bool | None = None, sim: float = 30.0) -> None:
        """Wait for a mavros/state with these values."""

        def holds() -> bool:
            state = self.state(index)
            return (
                state is not None
                and state.connected
                and (mode is None or state.mode == mode)
                and (armed is None or state.armed == armed)
            )

        self.wait(holds, f"{self.vehicles[index].name} is {mode or ''} {'' if armed is None else armed}", sim)

    def wait_landed(self, index: int, sim: float = 30.0) -> None:
        """Wait until mavros/state is disarmed, and the true motion, whose topic may lag behind, is on the ground."""
        self.wait_state(index, armed=False, sim=sim)
        self.wait(lambda: self.height(index) < 0.3, f"{self.vehicles[index].name} is on the ground", sim)

    def command(self, index: int, text: str) -> None:
        """Send an XTDrone command."""
        self.graph.say(f"/xtdrone/{self.vehicles[index].name}/cmd", _kind("std_msgs/String")(data=text))

    def settled(self, index: int, position: tuple[float, float, float], radius: float = 0.4) -> bool:
        """Return whether a vehicle is near a true position, m ENU."""
        pose = self.pose(index)
        if pose is None:
            return False
        p = pose.position
        return math.dist((p.x, p.y, p.z), position) < radius

    def fly(self, index: int, height: float) -> tuple[float, float, float]:
        """Take off to ``height`` above the spawn position in OFFBOARD by XTDrone's commands; return the position."""
        name = self.vehicles[index].name
        self.wait_state(index, sim=60.0)
        p = self.wait(lambda: self.pose(index), f"{name} has a pose").position
        place = (round(p.x, 1), round(p.y, 1), height)
        target = _kind("geometry_msgs/Pose")()
        target.position.x, target.position.y, target.position.z = place
        self.graph.say(f"/xtdrone/{name}/cmd_pose_enu", target)
        if self.state(index).mode != "OFFBOARD":
            self.command(index, "OFFBOARD")
            self.wait_state(index, mode="OFFBOARD")
        if not self.state(index).armed:
            self.command(index, "ARM")
            self.wait_state(index, armed=True)
        self.wait(lambda: self.settled(index, place, 0.3), f"{name} is at {place}")
        return place


def wait_for_ports(fleet: str = FLEET) -> None:
    """Wait until no other simulation uses the MAVLink ports."""

    def free() -> bool:
        try:
            check_vehicle_ports(parse_fleet(fleet))
        except OptionError:
            return False
        return True

    poll(free, f"the MAVLink ports of {fleet} are free", _PORTS_LIMIT)


@contextlib.contextmanager
def _master_of(graph: Graph) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in graph.environment.items():
            patch.setenv(name, value)
        yield


@pytest.fixture(scope="session")
def session_graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    graph = Graph(tmp_path_factory.mktemp("graph"))
    with _master_of(graph):
        graph.open()
    yield graph
    with _master_of(graph):
        graph.close()


@pytest.fixture(scope="module")
def graph(session_graph: Graph) -> Iterator[Graph]:
    """The master without the parameters and registrations of the module before."""
    with _master_of(session_graph):
        session_graph.forget()
        yield session_graph
        session_graph.forget()
