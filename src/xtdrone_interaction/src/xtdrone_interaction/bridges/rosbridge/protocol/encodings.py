"""Encodings of a topic's messages for clients: JSON, JSON in a PNG image, CBOR, or CBOR with the ROS serialisation.

Sources: ROSBRIDGE_PROTOCOL.md, sections 3.1.2 and 4; RFC 8949 (CBOR) and RFC 8746 (its typed arrays).
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from typing import Any

import cbor2
import cv2
import numpy as np

_CHANNELS = 3  # bytes of a pixel
_PADDING = b"\n"


def encode_json(operation: Mapping[str, Any], compression: str = "none") -> str:
    """Return an operation as JSON text.

    Args:
        operation: of JSON types, without NaN.
        compression: ``none``, or ``png``: packed by ``to_png`` into an operation ``png``.
    """
    text = json.dumps(operation, allow_nan=False, separators=(",", ":"))
    if compression == "png":
        return json.dumps({"op": "png", "data": base64.b64encode(to_png(text.encode())).decode("ascii")})
    return text


def to_png(data: bytes) -> bytes:
    """Return bytes as the pixels of an RGB image in PNG, row by row, padded with line feeds."""
    width = max(1, math.isqrt(len(data) // _CHANNELS))
    height = max(1, math.ceil(len(data) / (_CHANNELS * width)))
    padded = data.ljust(width * height * _CHANNELS, _PADDING)
    pixels = np.frombuffer(padded, np.uint8).reshape(height, width, _CHANNELS)
    done, packed = cv2.imencode(".png", pixels[..., ::-1])  # OpenCV's order is BGR
    if not done:
        raise ValueError(f"{width} x {height} pixels cannot be packed")
    return packed.tobytes()


def encode_cbor(topic: str, values: Any) -> bytes:
    """Return a message as a publish operation in CBOR.

    Args:
        topic: its name.
        values: the message's fields, with typed arrays (see ``cbor_values``).
    """
    return cbor2.dumps({"op": "publish", "topic": topic, "msg": values})


def encode_cbor_raw(topic: str, data: bytes, received: tuple[int, int]) -> bytes:
    """Return a message in ROS's serialisation as a publish operation in CBOR.

    Args:
        topic: its name.
        data: the serialised message.
        received: time of reception, s and ns.
    """
    message = {"secs": received[0], "nsecs": received[1], "bytes": data}
    return cbor2.dumps({"op": "publish", "topic": topic, "msg": message})
