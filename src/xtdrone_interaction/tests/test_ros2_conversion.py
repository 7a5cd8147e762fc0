"""Messages for ROS 2: the CDR that the bridge writes, read by the decoder of cyclonedds, sharing no code with it."""

from __future__ import annotations

import gc
import io
import time
from collections.abc import Callable
from typing import Any

import genpy
import numpy as np
import pytest
from random_messages import random_message

pytest.importorskip("rospy")

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from xtdrone_interaction.bridges.ros2 import dds_types
from xtdrone_interaction.bridges.ros2.dds_participant import Participant, Published, configuration, is_wanted
from xtdrone_interaction.bridges.ros2.message_conversion import ConversionError, converter
from xtdrone_interaction.topics.message_classes import installed_class

TYPES = [
    "std_msgs/String",
    "std_msgs/Bool",
    "std_msgs/Empty",
    "std_msgs/Float64",
    "std_msgs/Float64MultiArray",
    "std_msgs/Float32MultiArray",
    "std_msgs/Int32MultiArray",
    "std_msgs/Header",
    "std_msgs/ColorRGBA",
    "rosgraph_msgs/Clock",
    "geometry_msgs/PoseStamped",
    "geometry_msgs/TwistStamped",
    "geometry_msgs/Twist",
    "geometry_msgs/PoseWithCovarianceStamped",
    "geometry_msgs/Vector3",
    "geometry_msgs/TransformStamped",
    "nav_msgs/Odometry",
    "nav_msgs/Path",
    "nav_msgs/OccupancyGrid",
    "sensor_msgs/Imu",
    "sensor_msgs/MagneticField",
    "sensor_msgs/NavSatFix",
    "sensor_msgs/BatteryState",
    "sensor_msgs/Image",
    "sensor_msgs/CompressedImage",
    "sensor_msgs/CameraInfo",
    "sensor_msgs/LaserScan",
    "sensor_msgs/PointCloud2",
    "sensor_msgs/Range",
    "sensor_msgs/JointState",
    "sensor_msgs/FluidPressure",
    "tf2_msgs/TFMessage",
    "diagnostic_msgs/DiagnosticArray",
    "trajectory_msgs/JointTrajectory",
]


def serialised(message: Any) -> bytes:
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def plain(value: Any) -> Any:
    """Return a ROS 1 message or a structure of cyclonedds as nested lists of its fields' values, in their order."""
    if isinstance(value, (genpy.Time, genpy.Duration)):
        return [value.secs, value.nsecs]
    if isinstance(value, genpy.Message):
        names = [name for name in value.__slots__ if (value._type, name) != ("std_msgs/Header", "seq")]
        return [plain(getattr(value, name)) for name in names]
    if hasattr(value, "__idl__"):
        names = [name for name in value.__annotations__ if name != "structure_needs_at_least_one_member"]
        return [plain(getattr(value, name)) for name in names]
    if isinstance(value, (bytes, list, tuple)):
        return [plain(part) for part in value]
    return value


@pytest.mark.parametrize("type_", TYPES)
def test_an_independent_decoder_reads_what_the_bridge_writes_and_the_way_back_is_the_same(type_: str) -> None:
    kind = installed_class(type_)
    made = converter(type_, kind._md5sum)
    decoder = dds_types.structure(made.name)
    random = np.random.default_rng(7)
    for _ in range(5):
        message = random_message(kind, random)
        cdr = made.to_cdr(serialised(message))
        decoded = decoder.deserialize(cdr)
        assert plain(decoded) == plain(message)
        assert made.to_ros1(cdr) == serialised(message)
        # cyclonedds writes the same bytes itself, so the way back holds for foreign writers.
        own = decoded.serialize()
        assert own[:2] == b"\x00\x01"
        assert own[4:].rstrip(b"\0") == cdr[4:].rstrip(b"\0")
        assert made.to_ros1(own) == serialised(message)


def test_bytes_of_known_messages() -> None:
    # By hand from the OMG's CDR: encapsulation (little endian), length with the final zero, characters, zero.
    string = installed_class("std_msgs/String")
    made = converter("std_msgs/String", string._md5sum)
    assert made.to_cdr(serialised(string("hello"))) == b"\x00\x01\x00\x00\x06\x00\x00\x00hello\x00"
    empty = converter("std_msgs/Empty", installed_class("std_msgs/Empty")._md5sum)
    assert empty.to_cdr(b"") == b"\x00\x01\x00\x00\x00"  # ROS 2 encodes an empty structure as one byte
    arrows = converter("geometry_msgs/Vector3", installed_class("geometry_msgs/Vector3")._md5sum)
    vector = installed_class("geometry_msgs/Vector3")(1.0, 0.0, 0.0)
    assert arrows.to_cdr(serialised(vector)) == b"\x00\x01\x00\x00" + np.array([1.0, 0.0, 0.0]).tobytes()


@pytest.mark.parametrize("type_", ["mavros_msgs/State", "rosgraph_msgs/Log", "nope/Nope"])
def test_types_that_ros_2_does_not_have_are_refused(type_: str) -> None:
    with pytest.raises(ConversionError, match=f"type: {type_} is not bridged"):
        converter(type_, "")


def test_another_definition_than_the_standard_one_is_refused() -> None:
    with pytest.raises(ConversionError, match="with md5 sum 00 is not bridged"):
        converter("std_msgs/String", "00")


def test_bytes_that_are_no_message_are_refused() -> None:
    made = converter("std_msgs/String", installed_class("std_msgs/String")._md5sum)
    for data in (b"", b"\xff\xff\xff\xff", b"\x05\x00\x00\x00ab"):
        with pytest.raises(ConversionError, match="are no std_msgs/msg/String"):
            made.to_cdr(data)
        with pytest.raises(ConversionError, match="are no std_msgs/msg/String"):
            made.to_ros1(b"\x00\x01\x00\x00" + data)


def test_names_are_those_of_ros_2() -> None:
    assert dds_types.dds_topic("/iris_0/mavros/imu/data") == "rt/iris_0/mavros/imu/data"
    assert dds_types.ros_topic("rt/clock") == "/clock"
    assert dds_types.ros_topic("ros_discovery_info") == ""
    assert dds_types.dds_type_name("std_msgs/msg/String") == "std_msgs::msg::dds_::String_"
    assert dds_types.ros1_type("geometry_msgs::msg::dds_::Twist_") == "geometry_msgs/Twist"
    assert dds_types.ros1_type("std_srvs::srv::dds_::Empty_Request_") == ""


@pytest.mark.parametrize("interface", ["lo;", 'a"/>', "x" * 50])
def test_an_interface_that_is_no_name_is_refused(interface: str) -> None:
    with pytest.raises(ValueError, match="a network interface such as lo"):
        configuration(interface)


def test_a_participant_without_readers_waits_and_reads_each_writer_once(monkeypatch: pytest.MonkeyPatch) -> None:
    participant, other = Participant(231, "lo"), DomainParticipant(231)
    begin = time.monotonic()
    participant.wait(0.2)
    assert time.monotonic() - begin > 0.15, "a waitset without a condition does not wait"
    noted: list[Any] = []
    note = participant._note
    monkeypatch.setattr(participant, "_note", lambda endpoint: (noted.append(endpoint.key), note(endpoint)))
    own = participant.writer("/own", "std_msgs/msg/String")
    writers = [
        DataWriter(other, Topic(other, f"rt/{name}", dds_types.structure("std_msgs/msg/String"))) for name in "ab"
    ]
    _until(lambda: participant.published() == {Published("/a", "std_msgs/String"), Published("/b", "std_msgs/String")})
    for _ in range(20):
        participant.published()
    assert len(noted) == len(set(noted)) == 3
    del writers[0]
    gc.collect()
    _until(lambda: participant.published() == {Published("/b", "std_msgs/String")})
    assert not is_wanted(own)


def _until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
