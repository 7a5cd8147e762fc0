"""Images of ROS as JPEG: colours, greys, and depths by a fixed colour scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

QUALITY = 80
MOST_PIXELS = 4096 * 4096
FARTHEST = 20.0  # m at the end of the colour scale of depths
_PLAIN = {
    **{name: (3, "u1") for name in ("rgb8", "bgr8", "8UC3")},
    **{name: (4, "u1") for name in ("rgba8", "bgra8")},
    **{name: (1, "u1") for name in ("mono8", "8UC1")},
    **{name: (1, "u2") for name in ("mono16", "16UC1")},
    "32FC1": (1, "f4"),
}
"""Channels and NumPy type by encoding."""
_TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR, "bgra8": cv2.COLOR_BGRA2BGR}


class ImageError(ValueError):
    """A message that cannot be shown as an image."""


@dataclass(frozen=True)
class Picture:
    """A JPEG.

    Attributes:
        jpeg: its bytes.
        width, height: of the original image, px.
    """

    jpeg: bytes
    width: int
    height: int


def jpeg_of(message: Any, width: int) -> Picture:
    """Return a message as JPEG.

    Args:
        message: sensor_msgs/Image or sensor_msgs/CompressedImage.
        width: largest one, px; wider images are made smaller. Depths are coloured from 0 (red) to 20 m (blue), black
            where there is none.

    Raises:
        ImageError: its encoding is not known, or its data do not have its size.
    """
    compressed = not hasattr(message, "encoding")
    image = _decompressed(message) if compressed else _shown(_array(message), message.encoding)
    height, full = image.shape[:2]
    if full > width:
        image = cv2.resize(image, (width, max(1, round(height * width / full))), interpolation=cv2.INTER_AREA)
    elif compressed and message.data[:2] == b"\xff\xd8":
        return Picture(bytes(message.data), full, height)
    return Picture(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes(), full, height)


def _decompressed(message: Any) -> NDArray[Any]:
    image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR) if message.data else None
    if image is None or image.size > 3 * MOST_PIXELS:
        raise ImageError(f"data: {len(message.data)} bytes of format {message.format[:40]!r} are not an image")
    return image


def _array(message: Any) -> NDArray[Any]:
    """Return the pixels, shape (height, width) or (height, width, channels)."""
    if message.encoding not in _PLAIN:
        raise ImageError(f"encoding: {message.encoding[:40]!r} is not allowed, one of {', '.join(_PLAIN)}")
    channels, kind = _PLAIN[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = message.height, message.width, message.step
    row = width * channels * dtype.itemsize
    if not 0 < height * width <= MOST_PIXELS or step < row or len(message.data) < step * height:
        raise ImageError(
            f"data: {len(message.data)} bytes are not {height} rows of {step} bytes for {width} px {message.encoding}"
        )
    rows = np.frombuffer(message.data, np.uint8, step * height).reshape(height, step)[:, :row]
    pixels = np.ascontiguousarray(rows).view(dtype).reshape(height, width, channels)
    return pixels[..., 0] if channels == 1 else pixels


def _shown(pixels: NDArray[Any], encoding: str) -> NDArray[Any]:
    """Return pixels as 8 bits, grey or BGR."""
    if encoding in _TO_BGR:
        return cv2.cvtColor(pixels, _TO_BGR[encoding])
    if encoding == "mono16":
        return (pixels >> 8).astype(np.uint8)
    if encoding in ("16UC1", "32FC1"):
        return _coloured(pixels * 1e-3 if encoding == "16UC1" else pixels)
    return pixels


def _coloured(depth: NDArray[Any]) -> NDArray[Any]:
    """Return depths in m by colour; without a measurement black."""
    there = np.isfinite(depth) & (depth > 0.0)
    share = np.clip(np.where(there, depth, 0.0) / FARTHEST, 0.0, 1.0)
    colours = cv2.applyColorMap((255.0 * (1.0 - share)).astype(np.uint8), cv2.COLORMAP_JET)
    colours[~there] = 0
    return colours
