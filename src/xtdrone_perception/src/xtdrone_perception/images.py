"""Conversion of camera images to arrays."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from xtdrone_control.clouds import ScanError, image_rows

_CHANNELS = {"rgb8": 3, "bgr8": 3, "mono8": 1}


def picture_of(message: Any) -> NDArray[np.uint8]:
    """Return the colours of an image, (height, width, 3) red, green, blue.

    Raises:
        ScanError: The encoding is unknown, or the size does not match the data.
    """
    if message.encoding not in ("rgb8", "bgr8"):
        raise ScanError(f"encoding: {message.encoding!r} is not allowed, rgb8 or bgr8")
    rgb = image_rows(message, 3).reshape(message.height, message.width, 3)
    return np.ascontiguousarray(rgb if message.encoding == "rgb8" else rgb[..., ::-1])


def grey_of(message: Any) -> NDArray[np.uint8]:
    """Return the grey values of an image, (height, width).

    Raises:
        ScanError: The encoding is unknown, or the size does not match the data.
    """
    channels = _CHANNELS.get(message.encoding)
    if channels is None:
        raise ScanError(f"encoding: {message.encoding!r} is not allowed, {', '.join(_CHANNELS)}")
    rows = np.ascontiguousarray(image_rows(message, channels))
    if channels == 1:
        return rows
    code = cv2.COLOR_RGB2GRAY if message.encoding == "rgb8" else cv2.COLOR_BGR2GRAY
    return np.asarray(cv2.cvtColor(rows.reshape(message.height, message.width, 3), code))
