"""rosbridge's protocol without ROS: operations, waiting messages, encodings."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import cbor2
import cv2
import numpy as np
import pytest
from random_messages import random_message

pytest.importorskip("rospy")

from xtdrone_interaction.bridges.rosbridge.clients.subscription_queues import MAX_BYTES, UNTHROTTLED, SendQueue
from xtdrone_interaction.bridges.rosbridge.protocol.cbor_values import cbor_values
from xtdrone_interaction.bridges.rosbridge.protocol.encodings import encode_cbor, encode_cbor_raw, encode_json, to_png
from xtdrone_interaction.bridges.rosbridge.protocol.operations import OperationError, parse_operation
from xtdrone_interaction.topics.message_classes import installed_class
from xtdrone_interaction.topics.message_json import NotFinite, to_json


def test_an_operation_has_the_defaults_of_what_is_not_given() -> None:
    operation = parse_operation('{"op": "subscribe", "topic": "/a", "id": 3, "type": null, "more": 1}')
    assert (operation.op, operation.id) == ("subscribe", 3)
    assert operation.fields == {
        "topic": "/a",
        "type": None,
        "throttle_rate": 0,
        "queue_length": 0,
        "fragment_size": None,
        "compression": "none",
    }


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        ("rubbish", "is not JSON"),
        ("[" * 100_000, "nested too deep"),
        (b"\x00", "binary frame: not accepted"),
        ("[]", "a JSON object with a field op"),
        ('{"op": 7}', "op: 7 is not allowed, advertise, unadvertise"),
        ('{"op": "fly"}', "op: 'fly' is not allowed"),
        ('{"op": "fragment", "data": ""}', "fragment: fragments are not supported"),
        ('{"op": "auth", "mac": ""}', "auth: this server has no passwords"),
        ('{"op": "subscribe"}', "subscribe: topic: None is not allowed, a name"),
        ('{"op": "subscribe", "topic": "/a", "fragment_size": 100}', "fragment_size: 100 is not allowed, fragments"),
        ('{"op": "subscribe", "topic": "/a", "throttle_rate": -1}', "throttle_rate: -1 is not allowed, milliseconds"),
        ('{"op": "subscribe", "topic": "/a", "throttle_rate": true}', "throttle_rate: True is not allowed"),
        ('{"op": "subscribe", "topic": "/a", "throttle_rate": NaN}', "NaN is no JSON number, null stands for it"),
        ('{"op": "subscribe", "topic": "/a", "queue_length": 1e9}', "queue_length: 1000000000.0 is not allowed"),
        ('{"op": "subscribe", "topic": "/a", "compression": "zip"}', "compression: 'zip' is not allowed, none, png"),
        ('{"op": "publish", "topic": "/a", "msg": [1]}', "msg: [1] is not allowed, an object"),
        ('{"op": "call_service", "service": "/a", "args": 1}', "args: 1 is not allowed, an object, or a list"),
        ('{"op": "set_level", "level": "loud"}', "level: 'loud' is not allowed, none, error"),
        ('{"op": "subscribe", "topic": "/a", "id": {}}', "id: {} is not allowed, text or a whole number"),
    ],
)
def test_what_is_no_operation_is_refused(frame: str | bytes, text: str) -> None:
    with pytest.raises(OperationError) as refused:
        parse_operation(frame)
    assert text in str(refused.value)
    assert len(str(refused.value)) < 400


def test_a_refused_operation_keeps_its_id() -> None:
    with pytest.raises(OperationError) as refused:
        parse_operation('{"op": "subscribe", "id": "x"}')
    assert refused.value.id == "x"


def test_with_an_interval_the_newest_message_is_sent_when_it_has_passed() -> None:
    queue: SendQueue[int] = SendQueue(0.5, 0)
    sent, now = [], 0.0
    for i in range(100):  # 10 ms apart, exactly representable times
        now = i / 128
        queue.add(i, 1)
        if queue.delay(now) == 0.0:
            sent.append(queue.pop(now))
    assert sent == [0, 64]
    assert len(queue) == 1
    assert queue.delay(now) == pytest.approx(1.0 - 99 / 128)


def test_without_an_interval_a_burst_is_kept_whole_and_a_flood_is_not() -> None:
    queue: SendQueue[int] = SendQueue(0.0, 0)
    for i in range(UNTHROTTLED + 5):
        queue.add(i, 1)
    assert [queue.pop(0.0) for _ in range(len(queue))] == list(range(5, UNTHROTTLED + 5))


def test_large_messages_do_not_pile_up() -> None:
    queue: SendQueue[int] = SendQueue(0.0, 50)
    for i in range(50):
        queue.add(i, MAX_BYTES // 4)
    assert len(queue) == 4
    queue.add(50, 3 * MAX_BYTES)
    assert [queue.pop(0.0) for _ in range(len(queue))] == [50]


def test_a_png_holds_the_text_in_its_pixels() -> None:
    # Read as roslibjs does: the red, green and blue values of the pixels, row by row, are the text's bytes.
    for length in (1, 2, 3, 4, 11, 1000, 100_001):
        text = json.dumps({"op": "publish", "x": "ä" * length})
        packed = json.loads(encode_json({"op": "publish", "x": "ä" * length}, "png"))
        assert packed["op"] == "png"
        pixels = cv2.imdecode(np.frombuffer(base64.b64decode(packed["data"]), np.uint8), cv2.IMREAD_UNCHANGED)
        assert json.loads(pixels[..., ::-1].tobytes()) == json.loads(text)
    assert to_png(b"").startswith(b"\x89PNG")


def _python(value: Any) -> Any:
    """Return decoded CBOR, with typed arrays as lists."""
    layouts = {69: "<u2", 70: "<u4", 71: "<u8", 72: "i1", 77: "<i2", 78: "<i4", 79: "<i8", 85: "<f4", 86: "<f8"}
    if isinstance(value, cbor2.CBORTag):
        return np.frombuffer(value.value, layouts[value.tag]).tolist()
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, dict):
        return {name: _python(part) for name, part in value.items()}
    return [_python(part) for part in value] if isinstance(value, list) else value


@pytest.mark.parametrize(
    "type_",
    ["sensor_msgs/Image", "sensor_msgs/PointCloud2", "nav_msgs/Odometry", "mavros_msgs/State", "tf2_msgs/TFMessage"]
    + [f"std_msgs/{name}MultiArray" for name in ("Int8", "UInt16", "Int16", "UInt32", "Int64", "UInt64", "Float32")],
)
def test_cbor_has_the_values_of_json(type_: str) -> None:
    message = random_message(installed_class(type_), np.random.default_rng(3))
    operation = _python(cbor2.loads(encode_cbor("/t", cbor_values(message))))
    assert (operation["op"], operation["topic"]) == ("publish", "/t")
    text = json.dumps(to_json(message, not_finite=NotFinite.TEXT))
    assert operation["msg"] == json.loads(text, parse_constant=float) or "Infinity" in text


def test_cbor_keeps_nan_and_json_has_null() -> None:
    message = installed_class("std_msgs/Float64MultiArray")(data=[math.nan, 1.0])
    values = _python(cbor2.loads(encode_cbor("/t", cbor_values(message))))["msg"]["data"]
    assert math.isnan(values[0])
    assert json.loads(encode_json({"msg": to_json(message, not_finite=NotFinite.NULL)}))["msg"]["data"] == [None, 1.0]


def test_cbor_raw_has_the_bytes_and_the_time() -> None:
    operation = cbor2.loads(encode_cbor_raw("/t", b"\x01\x02", (3, 4)))
    assert operation == {"op": "publish", "topic": "/t", "msg": {"secs": 3, "nsecs": 4, "bytes": b"\x01\x02"}}
