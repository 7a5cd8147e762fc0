"""A follower's compiled turn equals its Python turn to the last bit: turn after turn, and as a node.

Run as a program, this file is a node of the second test: the swarm around the follower, or the follower itself, which
records the number of turns taken in Python.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rospy")
pytest.importorskip("xtdrone_native.follower_turn")

import rospy
from geometry_msgs.msg import PoseStamped, Twist, Vector3
from mavros_msgs.msg import PositionTarget, State
from ros_graph import PATIENCE, Graph
from std_msgs.msg import Float32MultiArray, Float64MultiArray, Int32MultiArray, String

import xtdrone_lockstep as lockstep
from xtdrone_control.communication.multirotor import MultirotorCommunication
from xtdrone_coordination import follower_nodes
from xtdrone_coordination.compiled_follower import is_stock
from xtdrone_coordination.follower import Follower, FollowerOptions, StarFollower
from xtdrone_coordination.follower_nodes import PATTERN_TOPIC, TOPOLOGY_TOPIC, FollowerNode
from xtdrone_coordination.known_swarm_state import SwarmState
from xtdrone_lockstep.ros_codec import compile_class
from xtdrone_lockstep.server import LockstepServer
from xtdrone_lockstep.transport.rospy_internals import set_time_us

COUNT = 12
ID = 5
VEHICLE = f"iris_{ID}"
SWARM = "/xtdrone/swarm"
TOPICS = (
    (PATTERN_TOPIC, Float32MultiArray),
    (TOPOLOGY_TOPIC, Int32MultiArray),
    (SWARM, Float64MultiArray),
    (f"/{VEHICLE}/mavros/state", State),
    (f"/{VEHICLE}/mavros/local_position/pose", PoseStamped),
    (f"/xtdrone/{VEHICLE}/cmd_vel_enu", Twist),
)
PERIOD_US = 32_000


# ---- turn by turn ----


class Publisher:
    """Serialises published messages."""

    def __init__(self, topic: str, kind: Any, **_: Any) -> None:
        self.codec = compile_class(kind)
        self.packets: list[bytes] = []
        self.seq = 0

    def publish(self, message: Any) -> None:
        self.seq += 1
        self.packets.append(self.codec.packet(message, self.seq))


class Side:
    """A follower's node and its vehicle's communication node, on topics of this test."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, options: FollowerOptions) -> None:
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.warnings: list[str] = []

        def subscriber(topic: str, kind: type, callback: Callable[[Any], None], **_: Any) -> None:
            self.callbacks[topic] = callback

        monkeypatch.setattr(lockstep, "Publisher", Publisher, raising=False)
        monkeypatch.setattr(lockstep, "Subscriber", subscriber, raising=False)
        monkeypatch.setattr(lockstep, "add_reset_hook", lambda hook: None, raising=False)
        self.follower = Follower(ID, COUNT, swarm=SwarmState(COUNT), options=options, warn=self.warnings.append)
        self.node = FollowerNode("iris", [self.follower])
        self.communication = MultirotorCommunication(VEHICLE, cmd_timeout=0.2, in_lockstep=True)
        self.work = self.node.compiled(self.communication)
        assert self.work is not None
        self.compiled_turns = 0
        self.carried = False

    def python(self, messages: list[list[Any]]) -> None:
        """Take a turn in Python."""
        for (topic, _), due in zip(TOPICS, messages, strict=True):
            for message in due:
                self.callbacks[topic](message)
        self.communication.step()
        self.node.step()

    def compiled(self, now_us: int, messages: list[list[Any]]) -> None:
        """Take a turn in compiled code if possible."""
        assert self.work is not None
        if not self.carried:
            self.carried = self.work.begin() is not None
        if self.carried:
            data = [
                [compile_class(kind).encode(message) for message in due]
                for (_, kind), due in zip(TOPICS, messages, strict=True)
            ]
            publishers: list[Any] = list(self.work.published)
            packets = self.work._program.take(now_us, data, [publisher.seq + 1 for publisher in publishers])
            if packets is not None:
                self.compiled_turns += 1
                for publisher, packet in zip(publishers, packets, strict=True):
                    publisher.seq += 1
                    publisher.packets.append(packet)
                return
            self.bring_up_to_date()
        self.python(messages)

    def bring_up_to_date(self) -> None:
        assert self.work is not None
        self.work.end()
        self.carried = False

    def state(self) -> Any:
        """Return everything that later turns depend on."""
        follower, core = self.follower, self.communication.core
        return (
            vars(follower.swarm),
            follower.offsets,
            follower.weights,
            follower.avoidance_vector,
            follower.problem_log.current,
            {name: value for name, value in vars(core).items() if name != "_log"},
            self.warnings,
        )


def array(kind: Any, data: Any) -> Any:
    return kind(data=np.asarray(data).ravel().tolist())


def random_turns(rng: np.random.Generator, turns: int) -> Iterator[list[list[Any]]]:
    """Yield the messages of each turn, except velocity commands: mostly regular, some irregular."""
    offsets = rng.uniform(-4.0, 4.0, (3, COUNT - 1)).astype(np.float32)
    topology = (rng.random((COUNT, COUNT)) < 0.3).astype(int)
    np.fill_diagonal(topology, 0)
    places = rng.uniform(-1.5, 1.5, (COUNT, 6))
    mode, armed = "POSCTL", False
    for turn in range(turns):
        places[:, :3] += rng.uniform(-0.05, 0.05, (COUNT, 3))
        shown = places.copy()
        if rng.random() < 0.03:
            shown[rng.integers(COUNT), rng.integers(6)] = (math.nan, math.inf)[rng.integers(2)]
        if rng.random() < 0.03:
            offsets = rng.uniform(-4.0, 4.0, (3, COUNT - 1)).astype(np.float32)
        if rng.random() < 0.05:
            mode, armed = ("OFFBOARD", "POSCTL")[rng.integers(2)], bool(rng.integers(2))
        poses = []
        for _ in range(rng.integers(3)):
            pose = PoseStamped()
            pose.header.frame_id = "map"
            p, q = pose.pose.position, pose.pose.orientation
            p.x, p.y, p.z = shown[ID, :3]
            q.x, q.y, q.z, q.w = rng.normal(size=4)
            poses.append(pose)
        yield [
            [array(Float32MultiArray, offsets)] if turn == 0 or rng.random() < 0.2 else [],
            [array(Int32MultiArray, topology)] if turn == 0 or rng.random() < 0.2 else [],
            [array(Float64MultiArray, shown)] * (0 if rng.random() < 0.02 else 1),
            [State(mode=mode, armed=armed)] if rng.random() < 0.2 else [],
            poses,
            [],
        ]


@pytest.mark.parametrize(
    "options",
    [FollowerOptions(), FollowerOptions(avoid="off", raw_weights=True, Kp=0.3), FollowerOptions(clearance=0.0)],
    ids=["default", "without avoidance", "without clearance"],
)
def test_equals_python_turn_by_turn(monkeypatch: pytest.MonkeyPatch, options: FollowerOptions) -> None:
    monkeypatch.setattr(follower_nodes.rospy, "get_param", lambda name, default: SWARM if "swarm" in name else default)
    monkeypatch.setattr(rospy.rostime, "_rostime_initialized", True)
    rng = np.random.default_rng(7)
    python, compiled = Side(monkeypatch, options), Side(monkeypatch, options)
    own = Twist()
    for turn, messages in enumerate(random_turns(rng, 1500)):
        now_us = (turn + 1) * PERIOD_US
        set_time_us(now_us)
        command = rng.random()
        if command < 0.9:  # otherwise the commands stop, and may time out
            still = (turn // 40) % 5 == 4 and command < 0.8  # at times within the dead zone
            scale = 0.0005 if still else 0.7
            own.linear.x, own.linear.y, own.linear.z, own.angular.z = scale * rng.uniform(-1.0, 1.0, 4)
            own.linear.x *= math.nan if command < 0.005 else 1.0
            messages[-1] = [own]
        python.python(messages)
        compiled.compiled(now_us, messages)
        for side in (python, compiled):
            side.packets = [publisher.packets[-1:] for publisher in side.work.published]
        assert compiled.packets == python.packets, turn
        if rng.random() < 0.1:
            if compiled.carried:
                compiled.bring_up_to_date()
            assert str(compiled.state()) == str(python.state()), turn
    assert 600 < compiled.compiled_turns < 1400


def test_only_a_follower_that_overrides_nothing_of_the_turn_is_compiled() -> None:
    class Restarting(Follower):
        def restart(self) -> None:
            super().restart()

    class Own(Follower):
        def control_law(self, position: Any, peers: Any) -> Any:
            return (0.0, 0.0, 0.0)

    class Counting(Follower):
        @property
        def avoidance_vector(self) -> Any:
            return (0.0, 0.0, 0.0)

        @avoidance_vector.setter
        def avoidance_vector(self, value: Any) -> None:
            pass

    assert is_stock(Follower(1, 3))
    assert is_stock(Restarting(1, 3))
    assert not any(is_stock(cls(1, 3)) for cls in (Own, Counting, StarFollower))
    follower = Follower(1, 3)
    follower.avoidance = lambda: (0.0, 0.0, 0.0)  # type: ignore[method-assign]
    assert not is_stock(follower)


# ---- the node ----

TURNS = 90


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    graph = Graph(tmp_path)
    yield graph
    graph.stop()


def swarm_around(out: str) -> None:
    """Publish a flight's messages to the follower, with a user's commands in between; record what it publishes."""
    lockstep.init_node("swarm", rate=30.0)
    publishers = {topic: lockstep.Publisher(topic, kind) for topic, kind in TOPICS[:-1]}
    user = lockstep.Publisher(f"/xtdrone/{VEHICLE}/cmd", String)
    late: list[lockstep.Subscriber] = []
    with open(out, "w", buffering=1) as file:

        def note(topic: str, message: Any) -> None:
            values = " ".join(str(message).split())
            print(rospy.Time.now().to_nsec() // 1000, topic, values, file=file)

        def hear(topic: str, kind: Any) -> lockstep.Subscriber:
            return lockstep.Subscriber(topic, kind, partial(note, topic))

        _keep = [
            hear(f"/{VEHICLE}/mavros/setpoint_raw/local", PositionTarget),
            hear(f"/xtdrone/{VEHICLE}/avoid_vel", Vector3),
        ]
        lockstep.start()
        turns = random_turns(np.random.default_rng(5), 1000)
        done = 0

        def step() -> None:
            nonlocal done
            done += 1
            for (topic, _), messages in zip(TOPICS[:-1], next(turns)[:-1], strict=True):
                for message in messages:
                    publishers[topic].publish(message)
            if done % 30 == 20:
                user.publish(String(data="HOVER"))
            if done == 45:  # connects a subscriber of the velocity command in flight
                late.append(hear(f"/xtdrone/{VEHICLE}/cmd_vel_enu", Twist))

        lockstep.spin(step)


def counted_follower(out: str, *arguments: str) -> int:
    """Run the follower's program; record the number of turns taken in Python."""
    step, python = FollowerNode.step, 0

    def counted(node: FollowerNode) -> None:
        nonlocal python
        python += 1
        step(node)

    FollowerNode.step = counted  # type: ignore[method-assign]
    sys.argv = [sys.argv[0], *arguments]
    status = follower_nodes.run_follower()
    Path(out).write_text(str(python))
    return status


def flown(graph: Graph, *, compiled: bool) -> tuple[list[str], int]:
    """Return the follower's messages, and the number of turns taken in Python."""
    said, counted = graph.folder / f"said {compiled}", graph.folder / f"turns {compiled}"
    server = LockstepServer()
    try:
        graph.master.setParam("/test", "/lockstep/uri", server.uri)
        graph.master.setParam("/test", "/xtdrone/swarm_topic", SWARM)
        arguments = ["iris", str(ID), str(COUNT), "_communication:=true", "_cmd_timeout:=0.3", f"_compiled:={compiled}"]
        follower = graph.start(sys.executable, __file__, "follower", str(counted), *arguments)
        swarm = graph.start(sys.executable, __file__, "swarm", str(said))
        names = [f"/follower_{ID}", "/swarm"]
        assert server.wait_for(names, timeout=PATIENCE), server.missing(names)
        for end in (TURNS, TURNS // 3):
            server.reset_time(0)
            now: int | None = 0
            while now is not None and now < end * 1_000_000 // 30:
                server.tick(now)
                now = server.next_due_us(now)
        assert sorted(server.participants) == names
    finally:
        server.close()
    assert follower.wait(PATIENCE) == 0, (graph.folder / "output").read_text()
    assert swarm.wait(PATIENCE) == 0
    return said.read_text().splitlines(), int(counted.read_text())


def test_publishes_what_python_publishes_in_a_graph(graph: Graph) -> None:
    python, python_turns = flown(graph, compiled=False)
    compiled, compiled_turns = flown(graph, compiled=True)
    assert compiled == python
    assert len(python) > 2 * TURNS
    assert len([line for line in python if "cmd_vel_enu" in line]) > TURNS // 2
    assert python_turns >= TURNS
    assert compiled_turns < python_turns - 20


if __name__ == "__main__":
    if sys.argv[1] == "swarm":
        swarm_around(sys.argv[2])
    else:
        sys.exit(counted_follower(*sys.argv[2:]))
