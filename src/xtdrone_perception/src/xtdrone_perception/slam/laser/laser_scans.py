"""Conversion of 2D laser scans to arrays."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MOST_RAYS = 100_000
_LONGEST = 1.0  # s, of a scan


class ReadScan(NamedTuple):
    """The returns of a laser scan: (n, 2) m in its plane, and times (n,) s after the stamp; the scan's duration."""

    points: Array
    times: Array
    duration: float


def read_scan(message: Any) -> ReadScan:
    """Return the valid returns of a sensor_msgs/LaserScan; other ranges are infinite or out of range (REP 117).

    Raises:
        ValueError: angles, times or number of rays are not allowed; the text names them.
    """
    ranges = np.asarray(message.ranges, float)
    if not 1 < len(ranges) <= _MOST_RAYS:
        raise ValueError(f"ranges: {len(ranges)} are not allowed, 2 to {_MOST_RAYS}")
    duration = message.time_increment * (len(ranges) - 1)
    if not (np.isfinite([message.angle_min, message.angle_increment]).all() and 0.0 <= duration <= _LONGEST):
        raise ValueError(
            f"angle_min {message.angle_min}, angle_increment {message.angle_increment}, time_increment "
            f"{message.time_increment}: not finite, or longer than {_LONGEST:g} s"
        )
    index = np.flatnonzero(np.isfinite(ranges) & (ranges >= message.range_min) & (ranges <= message.range_max))
    angle = message.angle_min + message.angle_increment * index
    points = ranges[index, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return ReadScan(points, message.time_increment * index, float(duration))
