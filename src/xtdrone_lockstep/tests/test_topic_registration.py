"""Connections of topics while the master's answers are late: none is lost, and the lockstep asks for those that are.

Run as a program, this file is one of the nodes.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from ros_master import RosMaster
from test_lockstep_nodes import PATIENCE
from test_lockstep_nodes import pytestmark as pytestmark

import xtdrone_lockstep as lockstep
from xtdrone_lockstep.server import LockstepServer, missing_connections

try:
    import rosgraph
    import rosmaster.master_api
    import rospy
    from rospy.impl import registration, tcpros_base, tcpros_pubsub
    from std_msgs.msg import String
    from test_lockstep_cpp import NODE

    from xtdrone_common.programs import plain_node
    from xtdrone_common.programs.plain_node import init_plain_node
    from xtdrone_lockstep.transport import rospy_internals
    from xtdrone_lockstep.transport import subscriber as subscriber_end
    from xtdrone_lockstep.transport.topic_reader import Reader

    MasterHandler: Any = rosmaster.master_api.ROSMasterHandler
except ImportError:
    MasterHandler = object

TOPICS = int(os.environ.get("REGISTERED_TOPICS", "24"))
"""Number of topics of each subscriber; hundreds for a trial by hand."""
LIMIT = float(os.environ.get("REGISTRATION_LIMIT", "60"))
"""Wall seconds to wait for their connections."""
SUBSCRIBERS = ("single", "together")


def topics(subscriber: str) -> list[str]:
    return [f"/t/{subscriber}/{index}" for index in range(TOPICS)]


def publishers_of(topic: str) -> int:
    """Return the number of publishers of a topic: all have a late one, half of them an early one, too."""
    return 2 if int(topic.rpartition("/")[2]) % 2 else 1


# ---- the nodes ----


def compute() -> None:
    """Keep this process's other threads from running, as a node does that computes."""
    for number in itertools.count():
        hash(number)


def publish(name: str) -> None:
    """Publish topics: half of them at once, the others as the standard input names them; requests are answered late."""
    delays = random.Random(name)
    handler = rospy.impl.masterslave.ROSHandler
    answer = handler.requestTopic

    def answer_late(*args: Any) -> Any:
        time.sleep(delays.random() * 0.02)
        return answer(*args)

    handler.requestTopic = answer_late
    init_plain_node(name)
    kept = []
    if name == "early":
        every = [topic for subscriber in SUBSCRIBERS for topic in topics(subscriber)]
        kept = [rospy.Publisher(topic, String, queue_size=1) for topic in every if publishers_of(topic) == 2]
    print("ready", flush=True)
    for line in sys.stdin:
        kept.append(rospy.Publisher(line.strip(), String, queue_size=1))


def subscribe(name: str) -> None:
    """Subscribe to topics, one by one or together, and report the connections that are not made."""
    init_plain_node(name)
    for _ in range(2):
        threading.Thread(target=compute, daemon=True).start()
    with lockstep.registering_together() if name == "together" else contextlib.nullcontext():
        ends = [rospy.Subscriber(topic, String) for topic in topics(name)]
    limit = time.monotonic() + LIMIT
    while (lost := sum(publishers_of(end.name) - end.get_num_connections() for end in ends)) > 0:
        if time.monotonic() > limit:
            for end in ends:
                print(end.name, [(link.endpoint_id, link.done) for link in end.impl.connections], file=sys.stderr)
            break
        time.sleep(0.05)
    print("lost", lost, flush=True)
    os._exit(0)


def ask_again(name: str) -> None:
    """Ask the master again for topics, and change the subscriptions before it answers."""
    init_plain_node(name)
    ends = {topic: rospy.Subscriber(topic, String) for topic in ("/t/again", "/t/gone", "/t/kept")}
    rospy_internals.ask_master_again(ends)
    sys.stdin.readline()
    for topic in ("/t/again", "/t/gone"):
        ends[topic].unregister()
    for topic in ("/t/again", "/t/new"):
        ends[topic] = rospy.Subscriber(topic, String)
    print("changed", flush=True)
    with rospy_internals._asking:
        print("answered", flush=True)
    sys.stdin.readline()


def participate(name: str, role: str) -> None:
    """Take part in the lockstep with one end of a topic."""
    lockstep.init_node(name, rate=50.0)
    make = lockstep.Publisher if role == "publishes" else lockstep.Subscriber
    _end = make("/from_a", String)
    lockstep.start()
    lockstep.spin(lambda: None)


# ---- the master and the test's side ----


class LateMaster(MasterHandler):
    """A master whose answers to subscribers come late, or that loses the first registration of each subscriber.

    Attributes:
        loses: Whether the first registration of a subscriber is answered with no publishers, and not kept.
        asked: Number of registrations by subscriber's name.
        questions: Released when a subscriber registers a topic the second time.
        may_answer: The second registration of a topic is computed and answered when this is set.
        on_subscriber: Called with a topic when the answer to its subscriber is computed and not yet sent.
    """

    def __init__(self, loses: bool) -> None:
        super().__init__(3)
        self.loses = loses
        self.asked: dict[str, int] = {}
        self.questions = threading.Semaphore(0)
        self.may_answer = threading.Event()
        self.may_answer.set()
        self.on_subscriber: Callable[[str], None] = lambda _: None
        self._delays = random.Random(5)
        self._registered: Counter[tuple[str, str]] = Counter()

    def registerSubscriber(self, name: str, topic: str, kind: str, uri: str) -> Any:  # noqa: N802 - XML-RPC's name
        if not topic.startswith(("/t/", "/from_")):
            return super().registerSubscriber(name, topic, kind, uri)
        self.asked[name] = self.asked.get(name, 0) + 1
        self._registered[name, topic] += 1
        if self._registered[name, topic] == 2:
            self.questions.release()
            self.may_answer.wait()
        if self.loses and self.asked[name] == 1:
            return 1, "", []
        answer = super().registerSubscriber(name, topic, kind, uri)
        if not self.loses:
            self.on_subscriber(topic)
            time.sleep(self._delays.random() * 0.04)
        return answer


class Nodes:
    """A master, and the processes of the nodes."""

    def __init__(self, loses: bool) -> None:
        self.master = LateMaster(loses)
        self._server = RosMaster(self.master)
        self.environment = {**os.environ, "ROS_MASTER_URI": self._server.uri, "ROS_IP": "127.0.0.1"}
        self.processes: list[subprocess.Popen[str]] = []

    def start(self, *command: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            command, env=self.environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.processes.append(process)
        return process

    def start_python(self, *arguments: str) -> subprocess.Popen[str]:
        return self.start(sys.executable, __file__, *arguments)

    def stop(self) -> None:
        self.master.may_answer.set()
        for process in self.processes:
            process.kill()
        for process in self.processes:
            process.communicate()
        self._server.close()


@pytest.fixture
def nodes(request: pytest.FixtureRequest) -> Iterator[Nodes]:
    nodes = Nodes(getattr(request, "param", False))
    yield nodes
    nodes.stop()


@pytest.mark.parametrize(
    ("lists", "publishers"),
    [
        ([["A", "B"], ["A"]], "AB"),  # a late answer after a newer notification
        ([["B"], []], "B"),
        ([["A"], ["A", "B"], []], "AB"),  # an answer older than two notifications
        ([["A", "B"], ["A"], ["A"]], "AB"),
        ([["A"], ["B"]], "AB"),  # a publisher that has started again on another port: its old one refuses
        ([[], ["A"]], "A"),
        ([[], []], ""),
    ],
)
def test_every_publisher_that_the_master_names_is_connected_in_whatever_order_its_lists_come(lists, publishers) -> None:
    connected: list[tuple[str, str]] = []

    class Handler:
        done = False

        def _connect_topic(self, topic: str, uri: str) -> tuple[int, str, int]:
            connected.append((topic, uri))
            return 1, "", 1

    handler = Handler()
    manager = registration.RegManager(handler)
    manager.publisher_update("/last", ["Z"])  # rospy begins at the end of the queue
    for uris in lists:
        manager.publisher_update("/x", uris)
        manager.publisher_update("/y", ["C"])
    before = set(threading.enumerate())
    loop = threading.Thread(target=manager.run)
    loop.start()
    while ("/last", "Z") not in connected:
        time.sleep(0.001)
    handler.done = True
    manager.publisher_update("/z", [])  # wakes it
    for thread in set(threading.enumerate()) - before:
        thread.join()
    assert set(connected) == {("/last", "Z"), ("/y", "C")} | {("/x", uri) for uri in publishers}
    assert len(connected) == len(set(connected))


def test_an_unknown_version_of_rospy_is_refused(monkeypatch) -> None:
    monkeypatch.setattr(registration.RegManager, "publisher_update", lambda self, name: None)
    with pytest.raises(ImportError, match="this version of rospy registers topics in an unknown way"):
        plain_node._check_registration()


def test_no_connection_is_lost_while_answers_are_late_and_threads_compute(nodes) -> None:
    publishers = [nodes.start_python("publish", name) for name in ("early", "late")]
    for process in publishers:
        assert process.stdout.readline() == "ready\n"
    writing = threading.Lock()

    def publish_late(topic: str) -> None:
        with writing:
            publishers[1].stdin.write(f"{topic}\n")
            publishers[1].stdin.flush()

    nodes.master.on_subscriber = publish_late
    subscribers = [nodes.start_python("subscribe", name) for name in SUBSCRIBERS]
    assert [process.stdout.readline() for process in subscribers] == ["lost 0\n"] * 2


def start_pair(nodes: Nodes, language: str) -> None:
    """Start a node that publishes, and one in ``language`` that subscribes to it."""
    nodes.start_python("participate", "a", "publishes")
    if language == "cpp":
        nodes.start(NODE, "participant", "b", "50", "0", "a", "b")
    else:
        nodes.start_python("participate", "b", "subscribes")


@pytest.mark.parametrize("nodes", [True], indirect=True)
@pytest.mark.parametrize("language", ["python", "cpp"])
def test_lockstep_asks_the_master_again_for_a_connection_that_is_not_made(nodes, language, monkeypatch) -> None:
    monkeypatch.setattr(missing_connections, "ASK_PERIOD", 0.2)
    said: list[str] = []
    server = LockstepServer(hang_limit=PATIENCE, connect_limit=PATIENCE, log=lambda _, text: said.append(text))
    rosgraph.Master("/test", nodes.environment["ROS_MASTER_URI"]).setParam("/lockstep/uri", server.uri)
    start_pair(nodes, language)
    assert server.wait_for(["/a", "/b"], timeout=PATIENCE), server.missing(["/a", "/b"])
    assert nodes.master.asked["/b"] >= 2
    server.tick(0)
    server.close()
    asked = "asking the master again for connections that are not made: /from_a from /a to /b"
    assert any(text.startswith(asked) for text in said)
    assert not any("continuing without it" in text for text in said)


@pytest.mark.parametrize("nodes", [True], indirect=True)
@pytest.mark.parametrize("language", ["python", "cpp"])
def test_turns_do_not_wait_for_a_master_that_is_asked_again(nodes, language, monkeypatch) -> None:
    monkeypatch.setattr(missing_connections, "ASK_PERIOD", 0.0)
    nodes.master.may_answer.clear()
    server = LockstepServer(hang_limit=20.0, connect_limit=0.2)  # the question precedes the end of the wait
    rosgraph.Master("/test", nodes.environment["ROS_MASTER_URI"]).setParam("/lockstep/uri", server.uri)
    start_pair(nodes, language)
    assert server.wait_for(["/a", "/b"], timeout=PATIENCE), server.missing(["/a", "/b"])
    assert nodes.master.questions.acquire(timeout=PATIENCE)
    for tick in range(3):
        server.tick(tick * 20_000)
    assert "/b" in server.participants
    nodes.master.may_answer.set()
    server.close()


def test_a_node_subscribes_and_unsubscribes_while_the_master_owes_an_answer(nodes) -> None:
    nodes.master.may_answer.clear()
    node = nodes.start_python("ask_again", "asker")
    assert nodes.master.questions.acquire(timeout=PATIENCE)
    node.stdin.write("\n")
    node.stdin.flush()
    assert node.stdout.readline() == "changed\n"
    nodes.master.may_answer.set()
    assert node.stdout.readline() == "answered\n"
    _, subscribers, _ = rosgraph.Master("/test", nodes.environment["ROS_MASTER_URI"]).getSystemState()
    asked = {topic for topic, names in subscribers if "/asker" in names and topic.startswith("/t/")}
    assert asked == {"/t/again", "/t/kept", "/t/new"}


def test_a_publisher_that_does_not_answer_is_asked_again(monkeypatch) -> None:
    monkeypatch.setattr(subscriber_end, "STALLED", 0.0)
    monkeypatch.setattr(tcpros_base, "_is_use_tcp_keepalive", lambda: False)  # asks the master
    end = subscriber_end.BufferingSubscriber("/x", String, Reader())
    with socket.create_server(("127.0.0.1", 0)) as silent:
        connection = tcpros_base.TCPROSTransport(tcpros_pubsub.TCPROSSub("/x", String), "/x")
        connection.set_endpoint_id("http://publisher")
        end.add_connection(connection)
        arguments = (connection, *silent.getsockname(), "http://publisher", end.receive_callback, "/x")
        thread = threading.Thread(target=tcpros_pubsub.robust_connect_subscriber, args=arguments)
        thread.start()
        accepted, _ = silent.accept()
        accepted.recv(1)  # the header has been sent, and is never answered
        assert end.has_connection("http://publisher")
        end.close_stalled()
        thread.join(PATIENCE)
        assert not thread.is_alive()
        accepted.close()
    assert not end.has_connection("http://publisher")  # the next list of the master makes a new one


def test_registration_managers_are_found_while_topics_are_registered_together(monkeypatch) -> None:
    manager = registration.RegManager(SimpleNamespace(done=True))
    listeners = registration.RegistrationListeners()
    listeners.add_listener(manager)
    monkeypatch.setattr(rospy_internals, "get_registration_listeners", lambda: listeners)
    with lockstep.registering_together():
        assert rospy_internals._registration_managers() == [manager]
    assert rospy_internals._registration_managers() == [manager]


if __name__ == "__main__":
    roles = {"publish": publish, "subscribe": subscribe, "ask_again": ask_again, "participate": participate}
    roles[sys.argv[1]](*sys.argv[2:])
