"""Inputs and outputs of one planner cycle, and the planner's settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Situation:
    """Inputs of one cycle.

    Attributes:
        time: s of ROS time of the setpoints: the current time plus the lead.
        position, velocity: (3,) m and m/s in map, the autopilot's estimate.
        yaw: rad, counter-clockwise from east.
        is_flying: armed and off the ground.
        is_offboard: whether the autopilot follows setpoints.
        map_count: number of measurements in the map.
        fault: the sensor's fault; empty: none.
    """

    time: float
    position: Array
    velocity: Array
    yaw: float
    is_flying: bool
    is_offboard: bool
    map_count: int
    fault: str = ""


class Command(NamedTuple):
    """A setpoint: position, velocity, acceleration, (3,) each in map, and yaw, rad."""

    position: Array
    velocity: Array
    acceleration: Array
    yaw: float
