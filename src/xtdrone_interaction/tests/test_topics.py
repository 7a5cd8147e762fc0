"""Topics of any type: field paths, JSON, classes from definitions, rates, all without a master."""

from __future__ import annotations

import contextlib
import io
import json
import math
from typing import Any

import genpy
import pytest
from geometry_msgs.msg import PoseStamped, TwistWithCovarianceStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from mavros_msgs.msg import State, WaypointList
from nav_msgs.msg import Path
from rosgraph_msgs.msg import Log
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float32, Header, String, Time, UInt8MultiArray

from xtdrone_interaction.topics.discovery import join_topics
from xtdrone_interaction.topics.field_paths import (
    FieldPathError,
    check_number,
    fields_of,
    number_at,
    parse_path,
    value_at,
)
from xtdrone_interaction.topics.message_classes import MessageTypeError, decode, message_class
from xtdrone_interaction.topics.message_json import MessageJsonError, NotFinite, from_json, to_json
from xtdrone_interaction.topics.rates import RateMeter, Throttle

DEFINITION = """Header header
uint8[] data
foreign_msgs/Part[2] parts
duration took
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: foreign_msgs/Part
float32[] values
bool good
"""


def packed(message: Any) -> bytes:
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


@pytest.fixture(scope="module")
def foreign() -> Any:
    return message_class("foreign_msgs/Whole", "*", DEFINITION)


# ---- JSON

FLOAT = st.floats(width=64)
TEXT = st.text(max_size=8)


@settings(deadline=None, derandomize=True)
@given(TEXT, FLOAT, st.lists(FLOAT, max_size=4), st.integers(0, 2**32 - 1), st.integers(0, 10**9 - 1))
def test_messages_survive_json_bit_by_bit(
    text: str, number: float, numbers: list[float], secs: int, nsecs: int
) -> None:
    state = JointState(name=[text, ""], position=numbers, velocity=[number])
    state.header.stamp.secs, state.header.stamp.nsecs = secs, nsecs
    written = json.dumps(to_json(state), allow_nan=False)
    again = from_json(JointState, json.loads(written))
    # JSON does not distinguish NaNs, so the texts are compared, and the bytes where there is no NaN.
    assert json.dumps(to_json(again)) == written
    if not any(math.isnan(value) for value in (number, *numbers)):
        assert packed(again) == packed(state)


def test_json_has_rosbridges_forms() -> None:
    image = Image(height=2, data=b"\x00\xff\x10")
    image.header.stamp.secs = 3
    written = to_json(image)
    assert written["data"] == "AP8Q"
    assert written["header"]["stamp"] == {"secs": 3, "nsecs": 0}
    assert to_json(Float32(math.nan)) == {"data": "NaN"}
    assert to_json(Float32(-math.inf)) == {"data": "-Infinity"}
    assert to_json(Float32(math.inf), not_finite=NotFinite.NULL) == {"data": None}
    assert math.isnan(from_json(Float32, {"data": None}).data)
    assert from_json(Image, {"data": [0, 255, 16]}).data == b"\x00\xff\x10"
    assert from_json(Time, {"data": 1.5}).data.nsecs == 500_000_000


def test_headers_without_a_stamp_get_rosbridges() -> None:
    """Fill them as rosbridge does (message_conversion.py, _to_object_inst and _to_time_inst)."""
    now = genpy.Time(12, 34)
    point = {"pose": {"position": {"x": 1.0}}}
    assert from_json(PoseStamped, {"header": {"frame_id": "map"}, **point}, now).header.stamp == now
    assert from_json(PoseStamped, {"header": {"stamp": {"secs": 5, "nsecs": 6}}}, now).header.stamp == genpy.Time(5, 6)
    assert from_json(PoseStamped, point, now).header.stamp == genpy.Time()
    nested = {"poses": [{"header": {}}, {"header": {"stamp": 1.5}}]}
    assert [pose.header.stamp.to_sec() for pose in from_json(Path, nested, now).poses] == [now.to_sec(), 1.5]
    assert from_json(Time, {"data": "now"}, now).data == now
    assert from_json(PoseStamped, {"header": {}}).header.stamp == genpy.Time()
    with pytest.raises(MessageJsonError):
        from_json(Time, {"data": "now"})


def test_long_arrays_are_shortened_on_request() -> None:
    state = JointState(position=[0.5] * 9)
    assert to_json(state, longest=3)["position"] == {"length": 9, "first": [0.5, 0.5, 0.5]}
    assert to_json(state, longest=9)["position"] == [0.5] * 9
    assert to_json(Image(data=bytes(1000)), longest=3)["data"] == {"length": 1000, "first": "AAAA"}
    assert to_json(String("x" * 30_000), longest=3)["data"] == {"length": 30_000, "first": "x" * 4000}
    assert to_json(String("x" * 30_000))["data"] == "x" * 30_000


@pytest.mark.parametrize(
    ("kind", "value", "text"),
    [
        (PoseStamped, {"pose": {"position": {"x": "far"}}}, "pose.position.x: 'far' is not allowed, a number, NaN"),
        (
            PoseStamped,
            {"pose": {"positoin": {}}},
            "pose: 'positoin' is no field of geometry_msgs/Pose, which has position",
        ),
        (PoseStamped, {"pose": 1}, "pose: 1 is not allowed, an object with the fields of geometry_msgs/Pose"),
        (PoseStamped, [], "message: [] is not allowed, an object with the fields of geometry_msgs/PoseStamped"),
        (Header, {"seq": -1}, "seq: -1 is not allowed, an integer from 0 to 4294967295"),
        (Header, {"seq": True}, "seq: True is not allowed, an integer"),
        (Header, {"stamp": {"secs": 0, "nsecs": 10**9}}, "stamp: {'secs': 0"),
        (Header, {"stamp": math.nan}, "stamp: nan is not allowed"),
        (Float32, {"data": 1e39}, "data: 1e+39 is not allowed, a number up to 3.403e+38"),
        (Float32, {"data": 10**400}, "is not allowed, a number up to"),
        (String, {"data": "\ud800"}, "data: '\\ud800' is not allowed, a text of Unicode"),
        (State, {"armed": "yes"}, "armed: 'yes' is not allowed, true or false"),
        (Image, {"data": "%"}, "data: '%' is not allowed, bytes in base 64"),
        (Image, {"data": [256]}, "data[0]: 256 is not allowed, an integer from 0 to 255"),
        (
            TwistWithCovarianceStamped,
            {"twist": {"covariance": [0.0]}},
            "twist.covariance: [0.0] is not allowed, 36 elem",
        ),
        (WaypointList, {"waypoints": [{"frame": 1}, {"command": 70000}]}, "waypoints[1].command: 70000 is not allowed"),
    ],
)
def test_bad_json_is_refused_by_field_and_value(kind: type, value: Any, text: str) -> None:
    with pytest.raises(MessageJsonError) as error:
        from_json(kind, value)
    assert text in str(error.value)


@settings(deadline=None, derandomize=True)
@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | FLOAT | TEXT,
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(["header", "waypoints", "command", "param1", "stamp", "secs"]), inner, max_size=3
            )
        ),
    )
)
def test_any_json_is_a_message_or_refused(value: Any) -> None:
    try:
        message = from_json(WaypointList, value)
    except MessageJsonError:
        return
    assert packed(message) is not None


# ---- classes from definitions


def test_a_foreign_type_is_decoded_by_its_definition(foreign: Any) -> None:
    message = from_json(foreign, {"parts": [{"values": [1.5]}, {"good": True}], "took": 2.5, "data": "AQI="})
    again = decode(foreign, packed(message))
    assert to_json(again)["parts"] == [{"values": [1.5], "good": False}, {"values": [], "good": True}]
    assert value_at(again, "parts[0].values[0]") == 1.5
    assert number_at(again, "took") == 2.5
    paths = {field.path: field.type for field in fields_of(foreign)}
    assert paths["parts[1].values[]"] == "float32"
    assert paths["header.stamp"] == "time"


def test_the_installed_class_is_used_for_its_own_md5_only() -> None:
    assert message_class("std_msgs/String", String._md5sum) is String
    with pytest.raises(MessageTypeError, match="md5 sum 00 has no definition, and md5 sum 992ce8"):
        message_class("std_msgs/String", "00")
    with pytest.raises(MessageTypeError, match="its publisher says 00"):
        message_class("std_msgs/String", "00", "string data")
    other = message_class("std_msgs/String", "*", "")
    assert other is String


@pytest.mark.parametrize(
    ("name", "definition", "text"),
    [
        ("foreign_msgs/A", "", "has no definition, and it is not installed"),
        ("foreign_msgs/A", "int32 1x x", "definition of foreign_msgs/A is not valid"),
        ("foreign_msgs/A", "gone_msgs/B b", "definition of foreign_msgs/A is not valid"),
        ("../etc/passwd", "", "type: '../etc/passwd' is not allowed"),
        ("os", "", "type: 'os' is not allowed"),
    ],
)
def test_unknown_types_are_refused_by_name(name: str, definition: str, text: str) -> None:
    with pytest.raises(MessageTypeError) as error:
        message_class(name, "12", definition)
    assert text in str(error.value)


@settings(deadline=None, derandomize=True)
@given(st.binary(max_size=60))
def test_bytes_that_do_not_match_are_refused(foreign: Any, data: bytes) -> None:
    for kind in (foreign, JointState, String):
        with contextlib.suppress(MessageTypeError):
            assert packed(decode(kind, data)) == data[: len(packed(decode(kind, data)))]


# ---- field paths


def test_paths_read_nested_fields_elements_and_times() -> None:
    pose = PoseStamped()
    pose.pose.position.x = 1.25
    pose.header.stamp.secs, pose.header.stamp.nsecs = 2, 500_000_000
    assert number_at(pose, "pose.position.x") == 1.25
    assert number_at(pose, "header.stamp") == 2.5
    assert number_at(UInt8MultiArray(data=b"\x07\x09"), "data[1]") == 9.0
    assert number_at(State(armed=True), "armed") == 1.0


@pytest.mark.parametrize("text", ["", ".x", "x.", "x..y", "[0]", "x[", "x[-1]", "x[1", "x y", "x[1]y z", "a" * 500])
def test_malformed_paths_are_refused(text: str) -> None:
    with pytest.raises(FieldPathError, match="is not allowed, a path such as"):
        parse_path(text)


@pytest.mark.parametrize(
    ("message", "path", "text"),
    [
        (PoseStamped(), "pose.pos.x", "'pos' is not there, but position, orientation"),
        (PoseStamped(), "pose.position", "is a geometry_msgs/Point, which cannot be plotted"),
        (PoseStamped(), "header.stamp.secs", "'secs' is not there, but no fields in a time"),
        (PoseStamped(), "pose[0]", "[0] is not there, but no elements in a geometry_msgs/Pose"),
        (JointState(position=[1.0]), "position[1]", "[1] is not there, but 1 elements now"),
        (Log(), "msg", "is a text, which cannot be plotted"),
        (Log(), "deserialize", "'deserialize' is not there"),
    ],
)
def test_paths_that_a_message_lacks_are_refused(message: Any, path: str, text: str) -> None:
    with pytest.raises(FieldPathError) as error:
        number_at(message, path)
    assert text in str(error.value)


def test_paths_are_checked_before_the_first_message(foreign: Any) -> None:
    for field in fields_of(foreign):
        path = field.path.replace("[]", "[7]")
        if field.plottable:
            check_number(foreign, path)
        else:
            with pytest.raises(FieldPathError, match="which cannot be plotted"):
                check_number(foreign, path)
    for path in ("parts[2].good", "parts.good", "data", "took.secs", "header.x", "data[0].x"):
        with pytest.raises(FieldPathError):
            check_number(foreign, path)


# ---- rates and discovery


def test_a_rate_falls_off_when_the_topic_ends() -> None:
    meter = RateMeter()
    assert meter.rates(0.0) == (0.0, 0.0)
    for i in range(21):
        meter.add(i * 0.1, 50)
    assert meter.rates(2.0) == pytest.approx((10.0, 500.0))
    assert meter.rates(4.0)[0] == pytest.approx(20 / 3.9)
    assert meter.rates(9.0) == (0.0, 0.0)
    assert meter.count == 21


@settings(deadline=None, derandomize=True)
@given(st.lists(st.floats(0.0, 0.2), min_size=1, max_size=80))
def test_a_throttle_passes_no_more_than_its_rate(gaps: list[float]) -> None:
    throttle, now, passed = Throttle(10.0), 0.0, []
    for gap in gaps:
        now += gap
        if throttle.wait(now) == 0.0:
            throttle.passed(now)
            passed.append(now)
    assert passed[0] == gaps[0]
    for i in range(len(passed) - 10):
        assert passed[i + 10] - passed[i] > 0.9


def test_masters_answers_become_topics_in_order() -> None:
    graph = join_topics([("/b", ["/n2", "/n1"])], [("/a", ["/n3"]), ("/b", ["/n3"])], [("/s", ["/n4"])], {"/b": "x/Y"})
    assert list(graph.topics) == ["/a", "/b"]
    assert graph.topics["/b"].publishers == ("/n1", "/n2")
    assert graph.topics["/a"].type == "*"
    assert graph.nodes == ["/n1", "/n2", "/n3", "/n4"]
