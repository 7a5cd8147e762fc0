"""Conversion of camera images to arrays."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}
_DEPTHS = {"32FC1": ("f4", 1.0), "16UC1": ("u2", 1e-3)}  # type and unit, m


def grey_of(message: Any) -> NDArray[np.uint8]:
    """Return the grey values of an image, (height, width).

    Raises:
        ValueError: unknown encoding, or a size that does not match the data.
    """
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        raise ValueError(f"encoding: {message.encoding!r} is not allowed, {', '.join(_CHANNELS)}")
    width, height, step = message.width, message.height, message.step
    if not width or not height or step < channels * width or len(message.data) != step * height:
        raise ValueError(f"{width} x {height} px in rows of {step} bytes, but {len(message.data)} bytes")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, : channels * width]
    if channels == 1:
        return np.ascontiguousarray(rows)
    code = cv2.COLOR_RGB2GRAY if message.encoding == "rgb8" else cv2.COLOR_BGR2GRAY
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows).reshape(height, width, 3), code))


def depth_of(message: Any) -> NDArray[np.float32]:
    """Return the depths of an image, (height, width) m, NaN where unknown (REP 118).

    Raises:
        ValueError: unknown encoding, or a size that does not match the data.
    """
    kind = _DEPTHS.get(message.encoding)
    if kind is None:
        raise ValueError(f"encoding: {message.encoding!r} is not allowed, {', '.join(_DEPTHS)}")
    item = np.dtype((">" if message.is_bigendian else "<") + kind[0])
    width, height, step = message.width, message.height, message.step
    if not width or not height or step < item.itemsize * width or len(message.data) != step * height:
        raise ValueError(f"{width} x {height} px in rows of {step} bytes, but {len(message.data)} bytes")
    rows = np.frombuffer(message.data, np.uint8).reshape(height, step)[:, : item.itemsize * width]
    depth = np.ascontiguousarray(rows).view(item).astype(np.float32) * np.float32(kind[1])
    depth[~(depth > 0.0)] = np.nan
    return depth
