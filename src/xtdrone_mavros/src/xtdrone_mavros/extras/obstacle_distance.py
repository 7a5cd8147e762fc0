"""Distances to obstacles in all directions, from a laser scan."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from sensor_msgs.msg import LaserScan

from xtdrone_mavros.lib.mav_frames import mav_frame
from xtdrone_mavros.link.ros_values_to_mavlink import whole
from xtdrone_mavros.relayed_messages import In
from xtdrone_mavros.uas import Plugin, Uas

_BINS = 72  # of an OBSTACLE_DISTANCE
_UNKNOWN = 65535
_LARGEST_INCREMENT = 255.0  # degrees


class ObstacleDistancePlugin(Plugin):
    """MAVROS's obstacle_distance: ``obstacle/send`` to OBSTACLE_DISTANCE in the frame ``obstacle/mav_frame``.

    As in MAVROS, the scan's angles are used as MAVLink's: clockwise, from north or from the heading.
    """

    name = "obstacle_distance"

    def __init__(self, uas: Uas) -> None:
        """Subscribe.

        Raises:
            ValueError: an unknown frame.
        """
        super().__init__(uas)
        self._frame = mav_frame(uas, "obstacle/mav_frame", "GLOBAL")
        row = In("obstacle/send", LaserScan, "OBSTACLE_DISTANCE", self._convert)
        uas.subscribe(row.topic, row.kind, lambda scan: row.forward(uas, scan))

    def _convert(self, scan: Any) -> dict[str, Any]:
        rays = len(scan.ranges)
        increment = math.degrees(scan.angle_increment) * max(rays / _BINS, 1.0)
        return {
            "distances": bins(scan.ranges),
            "increment": whole(min(max(increment, 0.0), _LARGEST_INCREMENT)),  # for readers of the old integer field
            "increment_f": increment,
            "min_distance": _centimetres(scan.range_min),
            "max_distance": _centimetres(scan.range_max),
            "angle_offset": math.degrees(scan.angle_min),
            "frame": self._frame,
        }


def bins(ranges: Sequence[float]) -> list[int]:
    """Convert a scan (m) to OBSTACLE_DISTANCE: 72 distances (cm), 65535 for unknown.

    For scans with more rays, each bin has its smallest range.
    """
    if len(ranges) <= _BINS:
        distances = [_distance(value, value >= 0.0) for value in ranges]
        return distances + [_UNKNOWN] * (_BINS - len(ranges))
    scale = len(ranges) / _BINS
    starts = [math.floor(i * scale) for i in range(_BINS)]
    return [
        min(_distance(value, value > 0.0) for value in ranges[start : start + math.ceil(scale)]) for start in starts
    ]


def _distance(metres: float, valid: bool) -> int:
    centimetres = metres * 100.0
    return int(centimetres) if valid and centimetres < _UNKNOWN else _UNKNOWN


def _centimetres(metres: float) -> int | float:
    """Convert a range limit to cm, limited to the field's range."""
    return _UNKNOWN if metres * 100.0 > _UNKNOWN else whole(metres * 100.0)
