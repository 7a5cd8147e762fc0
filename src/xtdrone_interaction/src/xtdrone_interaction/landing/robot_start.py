"""Where the robot of the landing demo starts: its distance from the UAV, its bearing and its heading."""

from __future__ import annotations

import math
import random

_SPAWN = (0.0, 3.0)  # m, of the UAV
_AWAY = 11.0  # m, of the robot at the start: out of sight
_ASIDE = 0.12  # rad, maximum angle between its heading and the UAV


def robot_start(seed: int) -> tuple[float, float, float]:
    """Return where the robot starts, x, y, m, and yaw, rad: somewhere around the UAV, facing it roughly."""
    generator = random.Random(seed)
    bearing, aside = generator.uniform(-math.pi, math.pi), generator.uniform(-_ASIDE, _ASIDE)
    x, y = _SPAWN[0] + _AWAY * math.cos(bearing), _SPAWN[1] + _AWAY * math.sin(bearing)
    return round(x, 3), round(y, 3), round(math.remainder(bearing + math.pi + aside, math.tau), 4)
