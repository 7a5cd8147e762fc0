"""The map of distances around a vehicle for collision prevention, filled from MAVLink messages as in PX4 v1.14.

One detail differs: in a message that covers the full circle the last direction is followed by the first one; PX4 reads
past the array there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from xtdrone_autopilot.state import OBSTACLE_BINS, OBSTACLE_UNKNOWN
from xtdrone_autopilot.vehicle_view import VehicleView

_BIN = 360 // OBSTACLE_BINS  # degrees
_LEAST_INCREMENT = 1e-3  # degrees
_FULL_TURN = 2.0 * math.pi
# MAV_FRAME: x to the north, and forward
NORTH_FRAMES, FORWARD_FRAME = (0, 1), 12
# MAV_SENSOR_ORIENTATION of sensors that look sideways: degrees clockwise from the nose
_ORIENTATIONS = {number: 45.0 * number for number in range(8)}
_CUSTOM_ORIENTATION = 100


class ObstacleMap:
    """Fills one vehicle's map from messages."""

    def __init__(self, view: VehicleView, get: Callable[[str], float]) -> None:
        """Prepare to write into the vehicle's record; ``get`` returns a parameter by name."""
        self._view = view
        self._get = get
        self._map: Any = view.control["obstacles"]

    @property
    def wanted(self) -> bool:
        """Whether collision prevention is switched on; without it messages are ignored."""
        return self._get("CP_DIST") > 0.0

    def add_directions(
        self, distances: Sequence[int], increment: float, offset: float, limits: tuple[float, float], *, north: bool
    ) -> None:
        """Add the distances of an OBSTACLE_DISTANCE message.

        Args:
            distances: cm, clockwise; 65535 for unknown, beyond the largest range for no obstacle.
            increment: degrees from one distance to the next; nothing is added below 0.001.
            offset: degrees of the first one from the nose, or from north.
            limits: range of the sensor, cm.
            north: whether ``offset`` counts from north.
        """
        if not increment >= _LEAST_INCREMENT or not math.isfinite(offset):
            return
        self._note(limits)
        count = len(distances)
        full_circle = increment * count >= 360.0
        turn = (math.degrees(self._view.yaw) if north else 0.0) - offset
        for i in range(OBSTACLE_BINS):
            index = math.ceil((turn + i * _BIN) % 360.0 / increment)
            index = index % count if full_circle else index
            if index < count and distances[index] != OBSTACLE_UNKNOWN:
                self._enter(i, float(distances[index]), limits[1])

    def add_sensor(
        self, orientation: int, q: Sequence[float], width: float, distance: float, limits: tuple[float, float]
    ) -> None:
        """Add the distance of a DISTANCE_SENSOR message that looks sideways; others are ignored.

        Args:
            orientation: MAV_SENSOR_ORIENTATION.
            q: (w, x, y, z), orientation of the sensor in the body frame for a custom orientation.
            width: horizontal field of view, rad.
            distance: m.
            limits: range of the sensor, m.
        """
        yaw = _ORIENTATIONS.get(orientation, _yaw_of(q) if orientation == _CUSTOM_ORIENTATION else math.nan)
        reading = min(distance, limits[1])
        if not math.isfinite(yaw) or not math.isfinite(width):
            return
        self._note((limits[0] * 100.0, limits[1] * 100.0))
        if reading <= limits[0]:
            return
        if reading < limits[1]:
            reading *= self._cosine_of_pitch()
        half = math.degrees(min(width, _FULL_TURN) / 2.0)
        first, last = (math.floor((yaw % 360.0 + side) / _BIN) for side in (-half, half))
        first, last = (bound + 1 if bound < 0 else bound for bound in (first, last))
        for i in range(first, last + 1):
            self._enter(i % OBSTACLE_BINS, math.floor(100.0 * reading + 0.5), math.floor(100.0 * limits[1] + 0.5))

    def _cosine_of_pitch(self) -> float:
        w, x, y, z = self._view.estimator["q"].tolist()
        return math.sqrt(max(1.0 - (2.0 * (w * y - z * x)) ** 2, 0.0))

    def _note(self, limits: tuple[float, float]) -> None:
        """Record the time of new data and the sensor's range, cm."""
        o = self._map
        o["time_us"] = self._view.time_us
        o["least"] = min(float(o["least"]), limits[0])
        o["largest"] = max(float(o["largest"]), limits[1])

    def _enter(self, i: int, distance: float, reach: float) -> None:
        """Write a distance (cm) into direction ``i``, unless a sensor of shorter range sees more there.

        Args:
            i: direction.
            distance: cm.
            reach: largest range of the sensor, cm.
        """
        o = self._map
        before, reach_before = float(o["distances"][i]), float(o["ranges"][i])
        empty = before >= reach_before
        if distance < reach:
            used = empty or reach <= reach_before
        else:
            used = reach >= reach_before if empty else reach == reach_before
        if used:
            o["distances"][i], o["ranges"][i] = distance, reach
            o["times_us"][i], o["covered"][i] = self._view.time_us, 1


def _yaw_of(q: Sequence[float]) -> float:
    """Return the heading of a quaternion (w, x, y, z), degrees; NaN if it is not finite."""
    w, x, y, z = q
    return math.degrees(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
