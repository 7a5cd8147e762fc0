"""Wheels on uneven ground: the pose of a robot follows the heights below its wheels.

Each wheel follows the ground at 45 degrees at most, so that a step is climbed as if over a wedge. The robot rests on
the plane that fits the four heights best: with slopes a and b along and across its heading, its z-y-x Euler angles are

    pitch = -atan(a),  roll = atan(b cos(pitch)).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_sim.rays.solid_ground import SolidGround

STEP = 0.3
"""Largest step that wheels climb or descend, in wheel radii."""

REACH = 0.3  # m above a wheel's last height from which the ground is searched downwards

Array = NDArray[np.float64]
Heights = tuple[float, float, float, float]


class Footprint(NamedTuple):
    """Contact points of the wheels: x of the rear and the front ones, and y of the left ones, in the robot, m."""

    rear: float
    front: float
    side: float


class Stand(NamedTuple):
    """Stance of a robot: height of its origin, m, roll and pitch, rad."""

    z: float
    roll: float
    pitch: float

    @property
    def tilt(self) -> float:
        """Angle between the robot's z axis and the vertical, rad."""
        return math.acos(min(1.0, math.cos(self.roll) * math.cos(self.pitch)))


def places(x: float, y: float, yaw: float, feet: Footprint) -> Array:
    """Return the positions of the wheels (4, 2), m, map: rear left, rear right, front left, front right."""
    c, s = math.cos(yaw), math.sin(yaw)
    own = ((feet.rear, feet.side), (feet.rear, -feet.side), (feet.front, feet.side), (feet.front, -feet.side))
    return np.array([(x + c * u - s * v, y + s * u + c * v) for u, v in own])


def heights_below(ground: SolidGround, at: Array, last: Sequence[float]) -> Heights:
    """Return the heights of the ground below wheels at ``at`` (4, 2), whose last heights were ``last``, m."""
    a, b, c, d = ground.heights(np.column_stack([at, np.array(last) + REACH])).tolist()
    return a, b, c, d


def follow(last: Heights, ground: Heights, ways: Sequence[float], step: float) -> Heights | None:
    """Return the heights of the wheels after they have rolled on; None in front of a step that is too high or too deep.

    Args:
        last: before, m.
        ground: below them, m.
        ways: distance that each of them has rolled, m.
        step: largest step, m.
    """
    changes = [b - a for a, b in zip(last, ground, strict=True)]
    if any(abs(change) > step + way for change, way in zip(changes, ways, strict=True)):
        return None
    a, b, c, d = (h + max(-way, min(way, change)) for h, change, way in zip(last, changes, ways, strict=True))
    return a, b, c, d


def stand_on(heights: Heights, feet: Footprint) -> Stand:
    """Return the stance of a robot on four heights, m, in the order of ``places``."""
    a, b, c, d = heights
    along = (0.5 * (c + d) - 0.5 * (a + b)) / (feet.front - feet.rear)
    across = (0.5 * (a + c) - 0.5 * (b + d)) / (2.0 * feet.side)
    pitch = math.atan2(-along, 1.0) if along else 0.0
    roll = math.atan(across * math.cos(pitch))
    return Stand(0.25 * (a + b + c + d) - along * 0.5 * (feet.rear + feet.front), roll, pitch)
