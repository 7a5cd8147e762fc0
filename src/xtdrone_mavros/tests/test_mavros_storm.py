"""Any message that ROS can carry, to every topic and service of the MAVROS layer: sent, or rejected with a message.

Messages are generated from their types, so the test includes later plugins without a change.
"""

from __future__ import annotations

import io
import math
import random
import re
import struct
from collections.abc import Callable
from typing import Any

import genpy
import pytest
import roslib.message
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from mavros_fakes import Bench
from mavros_msgs.msg import HomePosition, PositionTarget, Thrust, Waypoint
from mavros_msgs.srv import (
    CommandHomeRequest,
    CommandLongRequest,
    MessageIntervalRequest,
    ParamSetRequest,
    WaypointPushRequest,
)
from pymavlink.dialects.v20 import common as mavlink

from xtdrone_mavros.link.autopilot_links import Throttle
from xtdrone_mavros.link.ros_values_to_mavlink import FLOAT32_MAX
from xtdrone_mavros.plugins import PLUGINS
from xtdrone_mavros.plugins.ftp import FtpPlugin

ROUNDS = 60
FTP = struct.Struct("<HBBBBBBI")
FRAMES = "/iris_0/mavlink/to"  # accepts MAVLink frames only, which no random message is
NAMED = ("MPC_XY_VEL_MAX", "COM_RC_IN_MODE")  # parameters that the autopilot has: a real number and an integer
HOSTILE = (math.nan, math.inf, -math.inf, 1e300, -1e300, 1.7e308, -0.0, 5e-324, FLOAT32_MAX, 1.001 * FLOAT32_MAX)
INTEGER = re.compile(r"(u?)int(8|16|32|64)|byte|char")


def number(kind: str, rng: random.Random, wild: float) -> float | int | bool:
    """Return a number of a ROS type, with probability ``wild`` one at the edges of its range."""
    if kind == "bool":
        return rng.random() < 0.5
    match = INTEGER.fullmatch(kind)
    if match:
        unsigned, bits = (match[1] == "u" or kind == "char"), int(match[2] or 8)
        low, high = (0, (1 << bits) - 1) if unsigned else (-(1 << bits - 1), (1 << bits - 1) - 1)
        return rng.choice((low, high, high // 2 + 1)) if rng.random() < wild else rng.randint(0, 9)
    values = HOSTILE if kind == "float64" else [v for v in HOSTILE if not FLOAT32_MAX < abs(v) < math.inf]
    return rng.choice(values) if rng.random() < wild else rng.uniform(-90.0, 90.0)


def text(rng: random.Random, wild: float) -> str:
    if rng.random() < wild:
        return rng.choice(("", "x" * 5000, "\0\n\t", "ä" * 60, "%s%n{}", "a/b", "\U0001f681" * 20))
    return rng.choice((*NAMED, "OFFBOARD", "AUTO.LAND"))


def filled(kind: str, rng: random.Random, wild: float) -> Any:
    """Return a value of a ROS type with random contents."""
    base, _, length = kind.partition("[")
    if length:
        size = int(length[:-1]) if length != "]" else rng.randint(0, 3)
        values = [filled(base, rng, wild) for _ in range(size)]
        return bytes(v % 256 for v in values) if base in ("uint8", "char") else values
    if base == "time":
        return genpy.Time(rng.choice((0, 3, 2**32 - 1)), rng.choice((0, 999_999_999)))
    if base == "duration":
        return genpy.Duration(rng.choice((-(2**31), 0, 3, 2**31 - 1)), rng.choice((0, 999_999_999)))
    if base == "string":
        return text(rng, wild)
    if "/" not in base:
        return number(base, rng, wild)
    return message(roslib.message.get_message_class(base), rng, wild)


def message(cls: Any, rng: random.Random, wild: float) -> Any:
    return cls(*(filled(kind, rng, wild) for kind in cls._slot_types))


def over_the_wire(original: Any) -> Any:
    """Return the message as a subscriber receives it."""
    buffer = io.BytesIO()
    original.serialize(buffer)
    return type(original)().deserialize(buffer.getvalue())


class Autopilot:
    """Answers each request at once, in the thread that sends it, so that no service waits."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.items = 0
        self.send = bench.link.send
        bench.link.send = self.take  # type: ignore[method-assign]
        bench.uas.commands._send = bench.uas.plans._send = self.take
        [ftp] = (plugin for plugin in bench.uas.plugins if isinstance(plugin, FtpPlugin))
        ftp._client._send = self.take

    def take(self, asked: Any, component: int | None = None) -> None:
        self.send(asked, component)
        answer = getattr(self, asked.get_type().lower(), lambda _: None)(asked)
        if answer is not None:
            self.bench.link.replies[answer.id](self.bench.frame(answer))

    def command_long(self, m: Any) -> Any:
        return mavlink.MAVLink_command_ack_message(m.command, 0)

    command_int = command_long

    def set_mode(self, m: Any) -> Any:
        return mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_DO_SET_MODE, 0)

    def param_request_read(self, m: Any) -> Any:
        name = m.param_id
        if name not in NAMED:
            return mavlink.MAVLink_param_value_message(name.encode(), 0.0, 9, 2, 0)
        kind = 9 if name == NAMED[0] else 6
        return mavlink.MAVLink_param_value_message(name.encode(), 0.0, kind, 2, NAMED.index(name))

    def param_set(self, m: Any) -> Any:
        return mavlink.MAVLink_param_value_message(m.param_id.encode(), m.param_value, m.param_type, 2, 0)

    def param_request_list(self, m: Any) -> Any:
        return mavlink.MAVLink_param_value_message(NAMED[0].encode(), 0.0, 9, 1, 0)

    def mission_count(self, m: Any) -> Any:
        self.items = m.count
        return self.mission_next(0, m.mission_type)

    def mission_item_int(self, m: Any) -> Any:
        return self.mission_next(m.seq + 1, m.mission_type)

    def mission_next(self, seq: int, kind: int) -> Any:
        if seq < self.items:
            return mavlink.MAVLink_mission_request_int_message(1, 240, seq, kind)
        return mavlink.MAVLink_mission_ack_message(1, 240, 0, kind)

    def mission_clear_all(self, m: Any) -> Any:
        return mavlink.MAVLink_mission_ack_message(1, 240, 0, m.mission_type)

    def mission_request_list(self, m: Any) -> Any:
        return mavlink.MAVLink_mission_count_message(1, 240, 0, m.mission_type)

    def file_transfer_protocol(self, m: Any) -> Any:
        number, session, opcode, _, _, _, _, offset = FTP.unpack_from(bytes(m.payload))
        head = FTP.pack((number + 1) & 0xFFFF, session, 129, 1, opcode, 0, 0, offset)
        payload = (head + bytes([10])).ljust(251, b"\0")
        return mavlink.MAVLink_file_transfer_protocol_message(0, 1, 240, list(payload))

    def mission_set_current(self, m: Any) -> Any:
        return mavlink.MAVLink_mission_current_message(m.seq)


@pytest.fixture
def bench() -> Any:
    made = Bench(PLUGINS, {"conn": {"heartbeat_rate": 0.0}})
    Autopilot(made)
    yield made
    made.close()


def complete(bench: Bench, topic: str) -> Callable[[Any], None]:
    """Return a function that publishes to a topic, after the messages that its plugin needs beforehand."""
    name, callback = topic.removeprefix("/iris_0/mavros/"), bench.ros.subscribers[topic]
    pairs = {"setpoint_attitude/cmd_vel": ("thrust", Thrust), "setpoint_attitude/thrust": ("cmd_vel", TwistStamped)}

    def call(message: Any) -> None:
        if name in pairs:
            partner, kind = pairs[name]
            bench.call(f"setpoint_attitude/{partner}", kind(header=message.header))
        callback(message)
        if name == "setpoint_position/global_to_local":
            bench.send(
                mavlink.MAVLink_local_position_ned_message(0, *[0.0] * 6),
                mavlink.MAVLink_global_position_int_message(0, *[0] * 8),
            )
        if name == "setpoint_trajectory/local":
            bench.ros.time_ns += 2**32 * 1_000_000_000
            bench.uas.step(bench.ros.time_ns)

    return call


def storm(bench: Bench, call: Callable[[Any], Any], cls: Any, seed: str) -> tuple[int, int]:
    """Send random messages; return how many led to a datagram, and how many did not."""
    rng = random.Random(seed)
    sent = kept = 0
    for _ in range(ROUNDS):
        before = bench.link.sent
        bench.ros.time_ns += 10**9  # no message arrives too fast
        call(over_the_wire(message(cls, rng, rng.choice((0.0, 0.05, 0.3, 1.0)))))
        sent, kept = (sent + 1, kept) if bench.link.sent > before else (sent, kept + 1)
    return sent, kept


def test_every_topic_accepts_any_message(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    bench.uas._throttle = Throttle(0.0)
    topics = bench.ros.subscribers
    assert len(topics) >= 11
    for topic in topics:
        caplog.clear()
        sent, kept = storm(bench, complete(bench, topic), bench.ros.kinds[topic], topic)
        assert sent or topic == FRAMES, topic
        name = topic.removeprefix("/iris_0/mavros/").removeprefix("/iris_0/")
        warnings = [r for r in caplog.records if name in r.getMessage()]
        assert len(warnings) >= kept, topic  # each dropped message has a warning
        assert not any(r.exc_info for r in caplog.records), topic


def test_every_service_answers_any_request(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    services = bench.ros.services
    assert len(services) >= 25
    for name, handler in services.items():
        kind = bench.ros.kinds[name]

        def call(request: Any, handler: Any = handler, kind: Any = kind) -> None:
            over = over_the_wire(handler(request))
            assert isinstance(over, kind._response_class)

        storm(bench, call, kind._request_class, name)
        assert not any(r.exc_info for r in caplog.records), name


def test_another_vehicle_is_not_disturbed(bench: Bench) -> None:
    other = Bench(PLUGINS)
    try:
        for topic, callback in bench.ros.subscribers.items():
            storm(bench, callback, bench.ros.kinds[topic], topic)
        assert other.received() == []
        for one in (bench, other):
            one.received()
            one.call("setpoint_velocity/cmd_vel_unstamped", Twist())
            assert [m.get_type() for m in one.received()] == ["SET_POSITION_TARGET_LOCAL_NED"]
    finally:
        other.close()


def pose(x: float) -> PoseStamped:
    made = PoseStamped()
    made.pose.position.x = x
    return made


def home(latitude: float = 0.0, w: float = 1.0) -> HomePosition:
    made = HomePosition()
    made.geo.latitude, made.orientation.w = latitude, w
    return made


def raw(vy: float) -> PositionTarget:
    made = PositionTarget(coordinate_frame=1)
    made.velocity.y = vy
    return made


@pytest.mark.parametrize(
    ("topic", "sent", "words"),
    [
        ("setpoint_position/local", pose(1e300), "pose.position.x is 1e+300; -3.403e+38 to 3.403e+38"),
        ("setpoint_position/local", pose(math.nan), "pose.position.x is nan; -3.403e+38 to 3.403e+38"),
        ("vision_pose/pose", pose(-1e39), "pose.position.x is -1e+39; -3.403e+38 to 3.403e+38"),
        ("mocap/pose", pose(1e300), "pose.position.x is 1e+300; -3.403e+38 to 3.403e+38"),
        ("home_position/set", home(math.inf), "geo.latitude is inf; -3.403e+38 to 3.403e+38"),
        ("home_position/set", home(300.0), "SET_HOME_POSITION.latitude is 3000000000; -2147483648 to 2147483647"),
        ("home_position/set", home(w=1e300), "SET_HOME_POSITION.q[0] is 7.07106781"),
    ],
)
def test_a_value_out_of_range_is_reported_once(
    bench: Bench, caplog: pytest.LogCaptureFixture, topic: str, sent: Any, words: str
) -> None:
    for _ in range(20):
        bench.call(topic, sent)
    assert bench.received() == []
    [record] = caplog.records
    assert record.getMessage().startswith(f"/iris_0/mavros/{topic}: {words}")
    assert record.getMessage().endswith("is allowed; the message is not forwarded")


def test_a_masked_value_out_of_range_is_reported(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    """The autopilot ignores the masked value, but MAVLink cannot encode it."""
    target = raw(-1e300)
    target.type_mask = PositionTarget.IGNORE_VY
    bench.call("setpoint_raw/local", target)
    assert bench.received() == []
    assert "setpoint_raw/local: velocity.y is -1e+300" in caplog.text


@pytest.mark.parametrize(
    ("service", "request_", "words"),
    [
        ("mission/push", WaypointPushRequest(waypoints=[Waypoint(), Waypoint(x_lat=1e300)]), "MISSION_ITEM_INT.x is"),
        ("mission/push", WaypointPushRequest(waypoints=[Waypoint(frame=3, y_long=215.0)]), "MISSION_ITEM_INT.y is 215"),
        ("mission/push", WaypointPushRequest(waypoints=[Waypoint(), Waypoint(z_alt=1e39)]), "waypoints[1].z_alt is 1e"),
        ("mission/push", WaypointPushRequest(waypoints=[Waypoint()] * 65536), "MISSION_COUNT.count is 65536; 0 to 655"),
        ("set_message_interval", MessageIntervalRequest(1, math.nan), "message_rate is nan"),
        ("set_message_interval", MessageIntervalRequest(1, 1e-40), "COMMAND_LONG.param2 is 1.0000000000000001e+46"),
    ],
)
def test_an_oversized_request_is_rejected_before_sending(
    bench: Bench, caplog: pytest.LogCaptureFixture, service: str, request_: Any, words: str
) -> None:
    response = bench.ros.services[f"/iris_0/mavros/{service}"](request_)
    assert not response.success
    assert bench.received() == []
    assert f"/iris_0/mavros/{service}: {words}" in caplog.text


def test_numbers_at_the_edge_are_sent(bench: Bench) -> None:
    bench.call("setpoint_raw/local", raw(FLOAT32_MAX))
    assert bench.received()[0].vx == FLOAT32_MAX
    for request, service in (
        (CommandLongRequest(command=65535), "command"),
        (CommandHomeRequest(yaw=3e38), "set_home"),
    ):
        assert bench.ros.services[f"/iris_0/mavros/cmd/{service}"](request).success
    bench.received()


def test_a_parameter_that_does_not_fit_keeps_its_value(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    request = ParamSetRequest(param_id=NAMED[0])
    request.value.real = 1e300
    response = bench.ros.services["/iris_0/mavros/param/set"](request)
    assert (response.success, response.value.real) == (False, 0.0)
    assert "parameter MPC_XY_VEL_MAX cannot be 1e+300" in caplog.text
