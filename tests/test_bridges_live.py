"""The bridges on a flight of two vehicles, as their clients see it: Foxglove's protocol, roslibpy, DDS."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Iterator
from typing import Any

import pytest
from conftest import START_LIMIT, WALL_LIMIT, Graph, Stack, poll, wait_for_ports

pytest.importorskip("rospy")
pytest.importorskip("roslibpy")
pytest.importorskip("websockets")

import cbor2
import roslibpy
import rospy
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from foxglove_client import FoxgloveClient
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from xtdrone_interaction.bridges.ros2.dds_participant import configuration
from xtdrone_interaction.bridges.ros2.dds_types import structure

POSE = "/iris_0/mavros/local_position/pose"
SETPOINT = "/iris_0/mavros/setpoint_velocity/cmd_vel_unstamped"
FOXGLOVE, ROSBRIDGE = 8765, 9090


@pytest.fixture(scope="module")
def stack(graph: Graph, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A flight of two vehicles with all bridges, at most twice as fast as real time."""
    wait_for_ports()
    graph.forget()
    stack = Stack(graph, tmp_path_factory.mktemp("bridges"))
    try:
        arguments = ("vehicles:=iris:2", "rows:=2", "speed:=2", "foxglove:=true", "rosbridge:=true", "ros2:=true")
        stack.launch("multi_vehicle.launch", *arguments)
        stack.wait(lambda: stack.time > 0.0, "time runs", wall=START_LIMIT)
        for node in ("foxglove_bridge", "rosbridge_websocket"):
            poll(lambda node=node: rospy.has_param(f"/{node}/actual_port"), f"{node} listens", START_LIMIT)
        yield stack
    finally:
        stack.stop()


@pytest.fixture
def foxglove(stack: Stack) -> Iterator[FoxgloveClient]:
    client = FoxgloveClient(FOXGLOVE)
    yield client
    client.close()


@pytest.fixture(scope="module")
def ros(stack: Stack) -> Iterator[roslibpy.Ros]:
    client = roslibpy.Ros("127.0.0.1", ROSBRIDGE)
    client.run(WALL_LIMIT)
    yield client
    client.terminate()


def serialised(message: Any) -> bytes:
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


# ---- Foxglove


def test_foxglove_shows_topics_time_and_parameters(foxglove: FoxgloveClient) -> None:
    foxglove.wait(lambda: POSE in foxglove.channels)
    channel = foxglove.channels[POSE]
    assert (channel["encoding"], channel["schemaEncoding"]) == ("ros1", "ros1msg")
    assert channel["schemaName"] == "geometry_msgs/PoseStamped"
    assert channel["schema"] == PoseStamped._full_text
    number = foxglove.subscribe(POSE)
    foxglove.wait(lambda: len(foxglove.received[number]) > 2 and len(foxglove.times) > 2)
    pose = PoseStamped().deserialize(foxglove.received[number][-1])
    assert pose.header.frame_id == "map"
    assert 0.0 < pose.header.stamp.to_sec() <= foxglove.times[-1] * 1e-9 + 5.0
    assert foxglove.times == sorted(foxglove.times)

    foxglove.send({"op": "getParameters", "parameterNames": ["/xtdrone/fleet"], "id": "fleet"})
    answer = foxglove.wait(lambda: foxglove.last("parameterValues", id="fleet"))
    assert answer["parameters"][0]["value"] == "iris:2"
    foxglove.send({"op": "setParameters", "parameters": [{"name": "/tried/number", "value": 1.5}], "id": "set"})
    foxglove.wait(lambda: foxglove.last("parameterValues", id="set"))
    assert rospy.get_param("/tried/number") == 1.5
    foxglove.send({"op": "subscribeParameterUpdates", "parameterNames": ["/tried/number"]})
    rospy.set_param("/tried/number", 2.5)
    changed = {"name": "/tried/number", "value": 2.5, "type": "float64"}
    foxglove.wait(lambda: changed in [p for f in foxglove.frames for p in f.get("parameters", ())])


def test_foxglove_shows_the_nodes_of_topics_and_services(foxglove: FoxgloveClient) -> None:
    foxglove.send({"op": "subscribeConnectionGraph"})
    told: dict[tuple[str, str], list[str]] = {}

    def complete() -> bool:
        for frame in foxglove.frames:
            for kind, nodes in (("publishedTopics", "publisherIds"), ("advertisedServices", "providerIds")):
                told.update({(kind, entry["name"]): entry[nodes] for entry in frame.get(kind, ())})
        return told.get(("publishedTopics", POSE)) == ["/mavros"]

    foxglove.wait(complete)
    assert told["advertisedServices", "/iris_0/mavros/cmd/arming"] == ["/mavros"]


def test_foxglove_publishes_and_calls_and_is_told_what_is_not_allowed(foxglove: FoxgloveClient, graph: Graph) -> None:
    heard = graph.hear("/tried/from_foxglove", String)
    types = ((1, "ros1", "String"), (2, "json", "String"), (3, "ros1", "Int8"), (4, "cdr", "String"))
    channels = [
        {"id": i, "topic": "/tried/from_foxglove", "encoding": encoding, "schemaName": f"std_msgs/{name}"}
        for i, encoding, name in types
    ]
    foxglove.send({"op": "advertise", "channels": channels})
    foxglove.publish(1, serialised(String("one")))
    foxglove.publish(1, b"\xff\x00\x00\x00short")
    foxglove.publish(3, b"\x01")
    foxglove.publish(2, b'{"data": 7}')
    foxglove.publish(2, b'{"data": "two"}')
    foxglove.send("rubbish")
    foxglove.send(b"\x77rubbish")
    foxglove.wait(lambda: len(heard.messages) == 2)
    assert [message.data for message in heard.messages] == ["one", "two"]

    def told() -> str:
        return "\n".join(frame["message"] for frame in foxglove.frames if frame["op"] == "status")

    foxglove.wait(lambda: "7 is not allowed, a text" in told())
    for text in (
        "/tried/from_foxglove of type std_msgs/Int8 is not allowed, it has the type std_msgs/String",
        "encoding 'cdr' is not allowed, ros1 or json",
        "its 9 bytes are no std_msgs/String",
        "Invalid message",
    ):
        assert text in told()

    foxglove.wait(lambda: "/simulator/get_status" in foxglove.services)
    foxglove.call("/simulator/get_status", b"", 7)
    assert foxglove.wait(lambda: foxglove.last("response", callId=7))["data"]
    foxglove.wait(lambda: "/iris_0/mavros/cmd/arming" in foxglove.services)
    foxglove.call("/iris_0/mavros/cmd/arming", b"\x01\x02\x03", 8)
    failure = foxglove.wait(
        lambda: foxglove.last("serviceCallFailure", callId=8) or foxglove.last("response", callId=8)
    )
    assert failure["op"] in ("serviceCallFailure", "response")


# ---- rosbridge


def test_a_program_on_roslibpy_flies_a_vehicle(ros: roslibpy.Ros, stack: Stack) -> None:
    assert POSE in ros.get_topics()
    assert ros.get_topic_type(POSE) == "geometry_msgs/PoseStamped"
    assert ros.get_service_type("/iris_0/mavros/cmd/arming") == "mavros_msgs/CommandBool"
    assert "/mavros" in ros.get_nodes()
    assert ros.get_param("/xtdrone/fleet") == "iris:2"
    assert ros.get_time()["secs"] >= 0
    details = ros.get_message_details("geometry_msgs/PoseStamped")
    assert details["typedefs"][0]["fieldnames"] == ["header", "pose"]

    poses: list[Any] = []
    topic = roslibpy.Topic(ros, POSE, "geometry_msgs/PoseStamped", throttle_rate=50)
    topic.subscribe(poses.append)
    stack.wait(lambda: poses, "a pose comes")
    assert set(poses[-1]["header"]["stamp"]) == {"secs", "nsecs"}
    for name, type_, request in (
        ("set_mode", "SetMode", {"custom_mode": "AUTO.TAKEOFF"}),
        ("cmd/arming", "CommandBool", {"value": True}),
    ):
        service = roslibpy.Service(ros, f"/iris_0/mavros/{name}", f"mavros_msgs/{type_}")
        stack.wait(lambda s=service, r=request: _accepted(s, r), f"{name} is accepted", sim=120.0)
    stack.wait(lambda: stack.height(0) > 1.0, "it flies", sim=60.0)
    stack.wait(lambda: poses[-1]["pose"]["position"]["z"] > 1.0, "the client sees it")
    topic.unsubscribe()


def _accepted(service: roslibpy.Service, request: dict[str, Any]) -> bool:
    answer = service.call(roslibpy.ServiceRequest(request), timeout=WALL_LIMIT)
    return bool(answer.get("success", answer.get("mode_sent")))


def test_roslibpy_publishes_and_offers_a_service(ros: roslibpy.Ros, graph: Graph) -> None:
    heard = graph.hear("/tried/from_roslibpy", String)
    roslibpy.Topic(ros, "/tried/from_roslibpy", "std_msgs/String").publish(roslibpy.Message({"data": "first"}))
    poll(lambda: heard.messages, "the first message, although it was just advertised")

    def negate(request: Any, response: Any) -> bool:
        response["success"] = not request["data"]
        return True

    service = roslibpy.Service(ros, "/tried/service", "std_srvs/SetBool")
    service.advertise(negate)
    assert graph.call("/tried/service", SetBool, data=False).success
    service.unadvertise()


def _operation(socket: Any, op: str, limit: float = 60.0) -> Any:
    """Return the next operation of a kind."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        frame = socket.recv(timeout=limit)
        operation = cbor2.loads(frame) if isinstance(frame, bytes) else json.loads(frame)
        if operation["op"] == op:
            return operation
    raise AssertionError(f"no {op} within {limit:g} s")


def _send_more_than_allowed(socket: Any) -> None:
    """Send a frame longer than max_message_size; the server may close while it is sent, or after it."""
    socket.send("x" * 10_000_001)
    _operation(socket, "none")


def test_what_a_client_must_not_send_is_answered_and_the_server_goes_on(stack: Stack) -> None:
    refused = {
        "rubbish": "is not JSON",
        '{"op": "fragment"}': "fragments are not supported",
        '{"op": "subscribe", "topic": "/a b"}': "'/a b' is not allowed, a name",
        '{"op": "subscribe", "topic": "/clock", "type": "std_msgs/Int8"}': "it has the type rosgraph_msgs/Clock",
        '{"op": "unsubscribe", "topic": "/tried/none"}': "/tried/none is not subscribed to",
        '{"op": "publish", "topic": "/tried/none", "msg": {}}': "the type of /tried/none is unknown",
        f'{{"op": "publish", "topic": "{SETPOINT}", "msg": {{"linear": 7}}}}': "linear: 7 is not allowed, an object",
        '{"op": "advertise", "topic": "/tried/none", "type": "nope/Nope"}': "'nope/Nope' is not installed",
        '{"op": "advertise_service", "service": "/mavros/get_loggers", "type": "std_srvs/Empty"}': "offers it already",
    }
    with connect(f"ws://127.0.0.1:{ROSBRIDGE}", ping_interval=None) as socket:
        for frame, text in refused.items():
            socket.send(frame)
            assert text in _operation(socket, "status")["msg"]
        for name in ("/tried/none", "/rosapi/none"):
            socket.send(json.dumps({"op": "call_service", "service": name, "id": name}))
            answer = _operation(socket, "service_response")
            assert (answer["id"], answer["result"]) == (name, False)
        for i in range(501):
            socket.send(json.dumps({"op": "subscribe", "topic": f"/tried/number_{i}"}))
        assert "one too many, at most 500" in _operation(socket, "status")["msg"]
        with pytest.raises(ConnectionClosed):
            _send_more_than_allowed(socket)
    with pytest.raises(InvalidStatus):  # a page on another machine
        connect(f"ws://127.0.0.1:{ROSBRIDGE}", ping_interval=None, origin="http://example.org")  # type: ignore[arg-type]
    stack.pass_time(0.5)


def test_nan_and_the_compressions_of_a_topic(stack: Stack) -> None:
    publisher = rospy.Publisher("/tried/numbers", Float64MultiArray, queue_size=1, latch=True)
    publisher.publish(Float64MultiArray(data=[1.0, float("nan")]))
    with connect(f"ws://127.0.0.1:{ROSBRIDGE}", ping_interval=None) as socket:
        for compression, op in (("none", "publish"), ("png", "png"), ("cbor", "publish"), ("cbor-raw", "publish")):
            socket.send(json.dumps({"op": "subscribe", "topic": "/tried/numbers", "compression": compression}))
            operation = _operation(socket, op)
            if compression == "none":
                assert operation["msg"]["data"] == [1.0, None]
            if compression == "cbor":
                assert operation["msg"]["data"].tag == 86
            if compression == "cbor-raw":
                assert operation["msg"]["bytes"] == serialised(Float64MultiArray(data=[1.0, float("nan")]))
            socket.send(json.dumps({"op": "unsubscribe", "topic": "/tried/numbers"}))
    publisher.unregister()


def test_a_client_that_takes_nothing_costs_nothing(stack: Stack) -> None:
    with connect(f"ws://127.0.0.1:{ROSBRIDGE}", ping_interval=None, max_queue=1) as socket:
        for topic in ("/gazebo/model_states", POSE, "/iris_0/mavros/imu/data", "/clock"):
            socket.send(json.dumps({"op": "subscribe", "topic": topic}))
        stack.pass_time(5.0)  # the client does not read, and simulated time still advances
        with connect(f"ws://127.0.0.1:{ROSBRIDGE}", ping_interval=None) as other:
            other.send(json.dumps({"op": "subscribe", "topic": POSE}))
            assert _operation(other, "publish")["topic"] == POSE


# ---- ROS 2


def test_a_participant_of_dds_sees_the_flight_and_commands_it(stack: Stack, graph: Graph) -> None:
    _domain = Domain(0, configuration("lo"))
    participant = DomainParticipant(0)

    def reader(topic: str, name: str, *policies: Any) -> DataReader[Any]:
        return DataReader(participant, Topic(participant, f"rt/{topic}", structure(name)), qos=Qos(*policies))

    # The QoS of ROS 2's subscriptions: reliable by default, best effort for the clock.
    reliable = (Policy.Reliability.Reliable(max_blocking_time=10**9), Policy.History.KeepLast(10))
    clock = reader("clock", "rosgraph_msgs/msg/Clock", Policy.Reliability.BestEffort)
    poses = reader(POSE.strip("/"), "geometry_msgs/msg/PoseStamped", *reliable)
    pose = stack.wait(lambda: next(iter(poses.take(N=1)), None), "a pose comes", sim=600.0)
    assert pose.header.frame_id == "map"
    told = stack.wait(lambda: next(iter(clock.take(N=1)), None), "the clock comes", sim=600.0)
    assert abs(told.clock.sec - stack.time) < 60.0

    heard = graph.hear("/xtdrone/tried_0/cmd", String)
    writer = DataWriter(participant, Topic(participant, "rt/xtdrone/tried_0/cmd", structure("std_msgs/msg/String")))
    command = structure("std_msgs/msg/String")(data="OFFBOARD")

    def arrives() -> bool:
        writer.write(command)
        return bool(heard.messages)

    stack.wait(arrives, "the command arrives", sim=600.0)
    assert heard.last.data == "OFFBOARD"
