"""What the planner of a vehicle knows in a turn, and what it commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Situation:
    """A turn's inputs.

    Attributes:
        time: s of ROS time for which setpoints are made: the present and the lead.
        position, velocity: (3,) m and m/s in map, the autopilot's estimate.
        yaw: rad, anticlockwise from east.
        is_flying: armed and off the ground.
        is_offboard: whether setpoints are obeyed.
        map_count: number of measurements in the map.
        fault: why the sensor cannot be relied on; empty if it can.
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
