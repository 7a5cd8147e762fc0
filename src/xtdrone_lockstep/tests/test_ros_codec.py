"""The compiled codec against genpy's own methods, for every installed class of messages and services."""

from __future__ import annotations

import gc
import importlib
import io
import math
import random
import struct
import sys
from pathlib import Path
from typing import Any

import genmsg.msgs
import genpy
import genpy.dynamic
import numpy as np
import pytest
import rospy
import rospy.numpy_msg
from gazebo_msgs.msg import ModelStates
from geometry_msgs.msg import Point, PointStamped, Pose, PoseArray, PoseStamped, Quaternion, Vector3
from geometry_msgs.msg import Polygon as PolygonMessage
from mavros_msgs.msg import PositionTarget
from rosgraph_msgs.msg import Clock
from rospy.msg import serialize_message
from sensor_msgs.msg import CameraInfo, Image, LaserScan, PointCloud2
from std_msgs.msg import Bool, Float32, Float64MultiArray, Header, Int64, String, UInt8MultiArray, UInt64
from tf2_msgs.msg import TFMessage

from xtdrone_lockstep.ros_codec import compile_class

_INTEGERS = {f"{sign}int{bits}": (sign == "", bits) for sign in ("", "u") for bits in (8, 16, 32, 64)}
_INTEGERS |= {"byte": (True, 8), "char": (False, 8)}
_NAN = struct.unpack("<d", bytes.fromhex("010203000000f8ff"))[0]
_REALS = (_NAN, 0.0, -0.0, 1.0, -1.5, 1e-40, math.pi, math.inf, -math.inf, math.nan)
_TEXTS = ("", "map", "base_link", "Höhe über Grund", "无人机", "\U0001f681 \0 end", "x" * 300)


def _classes() -> list[Any]:
    """Return every generated class on the path."""
    found = []
    for kind, folder in [(kind, Path(entry)) for entry in sys.path for kind in ("msg", "srv")]:
        for package in sorted(path.parent.parent.name for path in folder.glob(f"*/{kind}/__init__.py")):
            module = importlib.import_module(f"{package}.{kind}")
            if not (module.__file__ or "").startswith(str(folder)):
                continue  # hidden by an overlay
            members = [getattr(module, name) for name in sorted(dir(module))]
            found += [cls for cls in members if isinstance(cls, type) and issubclass(cls, genpy.Message)]
    return found


CLASSES = _classes()


def _value(chance: random.Random, base: str) -> Any:
    if base in _INTEGERS:
        signed, bits = _INTEGERS[base]
        low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
        return chance.choice((low, high, 0, 1, chance.randint(low, high)))
    if base == "bool":
        return chance.random() < 0.5
    if base == "float64":
        return chance.choice((*_REALS, sys.float_info.max, 5e-324, chance.uniform(-1e3, 1e3)))
    if base == "float32":
        return struct.unpack("<f", struct.pack("<f", chance.choice((*_REALS, 3.4e38, chance.uniform(-1e3, 1e3)))))[0]
    if base == "string":
        return chance.choice(_TEXTS)
    if base in ("time", "duration"):
        value = genpy.Time() if base == "time" else genpy.Duration()
        value.secs = _value(chance, "uint32" if base == "time" else "int32")
        value.nsecs = chance.choice((0, 999_999_999, 1_000_000_000, chance.randrange(1 << 31)))
        return value
    return _message(chance, genpy.message.get_message_class(base))


def _field(chance: random.Random, slot_type: str) -> Any:
    base, is_array, length = genmsg.msgs.parse_type(slot_type)
    if not is_array:
        return _value(chance, base)
    count = chance.choice((0, 1, 2, 5)) if length is None else length
    if base in ("uint8", "char"):
        data = chance.randbytes(count)
        return chance.choice((data, bytearray(data), list(data), tuple(data)))
    values = [_value(chance, base) for _ in range(count)]
    return values if chance.random() < 0.7 else tuple(values)


def _message(chance: random.Random, message_class: Any) -> Any:
    message = message_class()
    for slot, slot_type in zip(message.__slots__, message._slot_types, strict=True):
        setattr(message, slot, _field(chance, slot_type))
    return message


def _bytes_by_genpy(message: Any) -> bytes:
    buffer = io.BytesIO()
    type(message).serialize.__wrapped__(message, buffer)
    return buffer.getvalue()


def _serialised(message: Any) -> bytes:
    buffer = io.BytesIO()
    message.serialize(buffer)
    return buffer.getvalue()


def _parts(value: Any) -> Any:
    """Return a value with the types of all its parts, so that equality implies equal bits."""
    if isinstance(value, (genpy.Message, genpy.TVal)):
        return type(value), [_parts(getattr(value, slot)) for slot in value.__slots__]
    if isinstance(value, (list, tuple)):
        return type(value), [_parts(item) for item in value]
    if isinstance(value, float):
        return float, struct.pack("<d", value)
    return type(value), value


@pytest.fixture(scope="module")
def samples() -> list[tuple[Any, bytes]]:
    """Return messages of all classes, and their bytes according to genpy."""
    chance = random.Random(1)
    for message_class in CLASSES:
        assert compile_class(message_class) is not None, message_class
    messages = [_message(chance, message_class) for message_class in CLASSES for _ in range(12)]
    messages += [message_class() for message_class in CLASSES]
    return [(message, _bytes_by_genpy(message)) for message in messages]


def test_bytes_equal_genpys(samples: list[tuple[Any, bytes]]) -> None:
    assert len(CLASSES) > 400
    for message, data in samples:
        assert compile_class(type(message)).encode(message) == data, type(message)  # type: ignore[union-attr]
        assert _serialised(message) == data


def test_values_and_their_types_equal_genpys(samples: list[tuple[Any, bytes]]) -> None:
    for message, data in samples:
        message_class = type(message)
        codec = compile_class(message_class)
        expected = _parts(message_class.deserialize.__wrapped__(message_class(), data))
        assert _parts(codec.decode(data)) == expected, message_class  # type: ignore[union-attr]
        assert _parts(message_class().deserialize(data)) == expected, message_class
        assert _parts(message.deserialize(data + b"rest")) == expected, message_class


def _constructed(message_class: Any, *args: Any, **kwds: Any) -> Any:
    """Return an object by the generated constructor."""
    message = message_class.__new__(message_class)
    message.__init__(*args, **kwds)
    return message


def test_new_messages_equal_those_of_the_generated_constructor(samples: list[tuple[Any, bytes]]) -> None:
    for message, _ in samples[::4]:
        message_class = type(message)
        assert _parts(message_class()) == _parts(_constructed(message_class))
        values = {slot: getattr(message, slot) for slot in message.__slots__}
        assert _parts(message_class(*values.values())) == _parts(_constructed(message_class, *values.values()))
        some = dict(list(values.items())[1:])
        assert _parts(message_class(**some)) == _parts(_constructed(message_class, **some))
        nothing = dict.fromkeys(values)
        assert _parts(message_class(**nothing)) == _parts(_constructed(message_class))


def test_new_messages_share_nothing() -> None:
    first, second = PoseStamped(), PoseStamped()
    assert first.header is not second.header
    assert first.header.stamp is not second.header.stamp
    assert Float64MultiArray().data is not Float64MultiArray().data
    assert CameraInfo().K is not CameraInfo().K
    mesh = CameraInfo(D=None)
    assert mesh.D == []


@pytest.mark.parametrize(("args", "kwds"), [((1, 2), {}), ((1, 2, 3), {"x": 1}), ((), {"w": 1}), ((), {"_type": "a"})])
def test_wrong_arguments_of_a_constructor_are_genpys_errors(args: Any, kwds: Any) -> None:
    compile_class(Point)
    with pytest.raises((TypeError, AttributeError)) as expected:
        _constructed(Point, *args, **kwds)
    with pytest.raises(type(expected.value)) as raised:
        Point(*args, **kwds)
    assert str(raised.value) == str(expected.value)


def test_every_truncation_is_an_error(samples: list[tuple[Any, bytes]]) -> None:
    """The codec rejects even a string cut at the end of the data, which genpy accepts."""
    chance = random.Random(2)
    for message, data in samples[::3]:
        codec = compile_class(type(message))
        cuts = range(len(data)) if len(data) < 60 else sorted(chance.sample(range(len(data)), 20))
        for cut in cuts:
            with pytest.raises(genpy.DeserializationError, match=type(message)._type):
                codec.decode(data[:cut])  # type: ignore[union-attr]
            with pytest.raises(genpy.DeserializationError):
                message.deserialize(data[:cut])


def test_changed_bytes_give_a_message_or_an_error(samples: list[tuple[Any, bytes]]) -> None:
    chance = random.Random(3)
    for message, data in samples:
        if not data:
            continue
        codec = compile_class(type(message))
        for _ in range(5):
            changed = bytearray(data)
            for _ in range(chance.randint(1, 4)):
                changed[chance.randrange(len(data))] = chance.choice((0, 1, 0x7F, 0x80, 0xFF))
            try:
                decoded = codec.decode(bytes(changed))  # type: ignore[union-attr]
            except genpy.DeserializationError:
                continue
            assert _parts(decoded) == _parts(type(message).deserialize.__wrapped__(type(message)(), bytes(changed)))


@pytest.mark.parametrize(
    "message_class", [String, UInt8MultiArray, Float64MultiArray, PoseArray, TFMessage, ModelStates]
)
def test_a_count_beyond_the_data_allocates_nothing(message_class: Any) -> None:
    empty = _serialised(message_class())
    codec = compile_class(message_class)
    assert codec is not None
    for start in range(0, len(empty) - 3, 4):
        for count in (1 << 20, (1 << 31) - 1, (1 << 32) - 1):
            data = empty[:start] + struct.pack("<I", count) + empty[start + 4 :]
            try:
                codec.decode(data)
            except genpy.DeserializationError as error:
                assert str(count) in str(error)  # noqa: PT017


def test_the_error_names_type_field_and_sizes() -> None:
    with pytest.raises(genpy.DeserializationError) as raised:
        PointStamped().deserialize(_serialised(PointStamped())[:-3])
    assert (
        str(raised.value)
        == "geometry_msgs/PointStamped: geometry_msgs/PointStamped.point takes at least 24 bytes, 21 are left"
    )
    with pytest.raises(genpy.DeserializationError) as raised:
        String().deserialize(b"\x05\0\0\0abc")
    assert str(raised.value) == "std_msgs/String: std_msgs/String.data has 5 bytes, 3 are left"


class _Number:
    def __init__(self, value: Any) -> None:
        self._value = value

    def __float__(self) -> float:
        return float(self._value)

    def __index__(self) -> int:
        return int(self._value)


ACCEPTED = [
    Float32(np.float32(0.1)),
    Float32(3),
    Float32(_Number(2.5)),
    Float32(True),
    Int64(np.int16(-3)),
    Int64(_Number(7)),
    UInt64(True),
    Bool(7),
    Bool(np.uint8(1)),
    Clock(rospy.Time(3, 4)),
    Clock(genpy.Duration(3, 4)),
    Header(stamp=rospy.Time(1, 2), frame_id="a"),
    String(str(np.str_("numpy"))),
    Float64MultiArray(data=np.arange(3.0)),
    Float64MultiArray(data=range(4)),
    Float64MultiArray(data={1.0: 2, 2.0: 3}),
    PoseArray(poses=(Pose(), Pose())),
    PolygonMessage(points=np.array([Point(), Point(1, 2, 3)])),
    PositionTarget(velocity=Point(1.0, 2.0, 3.0)),
    PoseStamped(pose=rospy.numpy_msg.numpy_msg(Pose)()),
    CameraInfo(K=np.eye(3).ravel()),
    LaserScan(ranges=np.ones(5, np.float32)),
    Image(data=np.zeros(4, np.uint8).tobytes()),
    PointCloud2(data=[1, 2, 255]),
]
"""Values of other types than the field's that genpy accepts."""


@pytest.mark.parametrize("message", ACCEPTED, ids=lambda message: type(message).__name__)
def test_other_types_are_accepted_as_by_genpy(message: Any) -> None:
    assert compile_class(type(message)) is not None
    assert _serialised(message) == _bytes_by_genpy(message)


REJECTED = [
    Float32("1"),
    Float32(1e39),
    Int64(1.5),
    Int64(1 << 63),
    UInt64(-1),
    UInt64(1 << 64),
    Bool(256),
    String(b"bytes"),
    String(5),
    String("\ud800"),
    Clock(3.5),
    Header(stamp=None, frame_id=None),
    CameraInfo(K=[0.0] * 8),
    Float64MultiArray(data=["a"]),
    Float64MultiArray(data=3),
    UInt8MultiArray(data=[256]),
    UInt8MultiArray(data="text"),
    UInt8MultiArray(data=np.zeros(3, np.uint8)),
    PoseArray(poses=[Pose(), None]),
    PoseStamped(pose=Point()),
]
"""Values that genpy does not accept."""


@pytest.mark.parametrize("message", REJECTED, ids=lambda message: type(message).__name__)
def test_errors_are_genpys(message: Any) -> None:
    message_class = type(message)
    assert compile_class(message_class) is not None
    if isinstance(message, Header):
        message.stamp, message.frame_id = None, None
    with pytest.raises(Exception) as expected:  # noqa: PT011
        message_class.serialize.__wrapped__(message, io.BytesIO())
    with pytest.raises(type(expected.value)) as raised:
        message.serialize(io.BytesIO())
    assert str(raised.value) == str(expected.value)


def test_fixed_bytes_are_cut_and_filled_up_as_by_genpy() -> None:
    (field,) = (cls for cls in CLASSES if cls._type == "uuid_msgs/UniqueID")
    for length in (0, 15, 16, 17):
        message = field(b"x" * length)
        assert _serialised(message) == _bytes_by_genpy(message)


def test_text_that_is_not_utf8_is_replaced_as_by_genpy(caplog: pytest.LogCaptureFixture) -> None:
    data = struct.pack("<I", 5) + b"a\xff\xc3(b"
    codec = compile_class(String)
    assert codec is not None
    expected = String.deserialize.__wrapped__(String(), data)
    genpy.message._warned_decoding_error.clear()
    assert codec.decode(data) == expected
    assert "Characters replaced when decoding message std_msgs/String" in caplog.text


def test_the_objects_of_a_message_are_filled_in_place() -> None:
    message = PoseStamped()
    header, position, stamp = message.header, message.pose.position, message.header.stamp
    message.pose.orientation = None
    data = _serialised(PoseStamped(header=Header(seq=4, stamp=rospy.Time(5, 6)), pose=Pose(position=Point(1, 2, 3))))
    assert message.deserialize(data) is message
    assert (header.seq, stamp.secs, position.z, message.pose.orientation.w) == (4, 5, 3.0, 0.0)
    message.header.stamp = rospy.Time()
    message.deserialize(data)
    assert message.header.stamp == rospy.Time(5, 6)
    assert type(message.header.stamp) is rospy.Time


def test_data_that_are_no_bytes() -> None:
    codec = compile_class(Image)
    assert codec is not None
    image = Image(data=b"abc")
    assert codec.decode(memoryview(_serialised(image))) == image
    assert type(codec.decode(bytearray(_serialised(image))).data) is bytes
    assert type(UInt8MultiArray().deserialize(bytearray(_serialised(UInt8MultiArray(data=b"ab")))).data) is bytearray
    with pytest.raises(TypeError, match="bytes-like"):
        codec.decode("text")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "message", [PoseStamped(), String("a"), Header(), TFMessage(), PositionTarget(velocity=Point())]
)
def test_packets_equal_rospys(message: Any) -> None:
    codec = compile_class(type(message))
    assert codec is not None
    if hasattr(message, "header"):
        message.header.frame_id = None
    buffer = io.BytesIO()
    serialize_message(buffer, 9, message)
    if hasattr(message, "header"):
        message.header.seq, message.header.frame_id = 0, None
    packet = codec.packet(message, 9)
    if isinstance(message, PositionTarget):
        assert packet is None
        return
    assert packet == buffer.getvalue()
    if hasattr(message, "header"):
        assert (message.header.seq, message.header.frame_id) == (9, "0")


def test_classes_that_genpy_has_not_generated_keep_their_methods() -> None:
    class Derived(Pose):
        pass

    dynamic = genpy.dynamic.generate_dynamic("geometry_msgs/Pose", Pose._full_text)["geometry_msgs/Pose"]
    for message_class in (rospy.AnyMsg, rospy.numpy_msg.numpy_msg(LaserScan), Derived, dynamic):
        assert compile_class(message_class) is None
    assert _serialised(Derived()) == _serialised(Pose()) == _serialised(dynamic())
    assert Derived().deserialize(_serialised(Pose())).position == Point()
    assert type(Derived(position=Point(1, 2, 3)).orientation) is Quaternion


def test_a_list_that_changes_while_it_is_written() -> None:
    values: list[Any] = []

    class Vanishing:
        def __float__(self) -> float:
            values.clear()
            gc.collect()
            return 1.0

    codec = compile_class(Float64MultiArray)
    assert codec is not None
    values.extend([Vanishing(), 2.0, 3.0])
    assert codec.encode(Float64MultiArray(data=values)) is None

    message = PoseStamped()

    class Removing:
        def __float__(self) -> float:
            message.pose = None
            gc.collect()
            return 1.0

    message.pose.position = Point(Removing(), 0.0, 0.0)
    assert len(compile_class(PoseStamped).encode(message)) == len(_serialised(PoseStamped()))  # type: ignore


def test_an_interrupt_is_not_swallowed() -> None:
    class Interrupted:
        def __float__(self) -> float:
            raise KeyboardInterrupt

    codec = compile_class(Float32)
    assert codec is not None
    with pytest.raises(KeyboardInterrupt):
        codec.encode(Float32(Interrupted()))


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * 4096


def test_a_value_may_leave_its_message_while_it_is_encoded() -> None:
    class Leaving(list[float]):
        def __len__(self) -> int:
            message.data = []
            return 2

    message = Float64MultiArray()
    for _ in range(100):
        message.data = Leaving([1.5, 2.5])
        codec = compile_class(Float64MultiArray)
        assert codec is not None
        codec.encode(message)


def test_no_memory_is_lost() -> None:
    """Over 48 000 conversions, valid and invalid, a leak of 16 bytes each would lose 768 kB."""
    states = ModelStates(name=["a", "ü"], pose=[Pose(), Pose()])
    stray = TFMessage([None])
    codecs = [compile_class(cls) for cls in (ModelStates, PositionTarget, TFMessage, CameraInfo)]
    data = [_serialised(states), _serialised(PositionTarget()), _serialised(TFMessage()), _serialised(CameraInfo())]

    def rounds(count: int) -> None:
        target = PositionTarget()
        for _ in range(count):
            for codec, content in zip(codecs, data, strict=True):
                assert codec is not None
                codec.packet(codec.decode(content), 5)
                with pytest.raises(genpy.DeserializationError):
                    codec.decode(content[:-1])
            codecs[2].encode(stray)  # type: ignore[union-attr]
            PositionTarget(header=None, yaw=1.5)
            Vector3(1.5, 2.5, None)
            target.deserialize(data[1])

    rounds(500)
    gc.collect()
    objects = len(gc.get_objects())  # called once beforehand, as its list of up to 1 MB stays in the process's heap
    before = _resident()
    references = sys.getrefcount(Vector3), sys.getrefcount(genpy.Time), sys.getrefcount("frame_id")
    rounds(12_000)
    gc.collect()
    assert _resident() - before < 400_000
    assert abs(len(gc.get_objects()) - objects) < 200
    assert (sys.getrefcount(Vector3), sys.getrefcount(genpy.Time), sys.getrefcount("frame_id")) == references
