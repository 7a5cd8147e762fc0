"""Dynamic window: the best motion that the vehicle can reach within one cycle and from which it can stop.

D. Fox, W. Burgard, S. Thrun, The dynamic window approach to collision avoidance, IEEE Robotics and Automation Magazine
4, 1997: reachable speeds and yaw rates define arcs; those on which the vehicle cannot stop before an obstacle are
inadmissible; of the others, the one with the best weighted sum of heading, clearance and speed is commanded. As in
ROS's dwa_local_planner, progress along the global path also counts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.kernel import kernel
from xtdrone_planning.navigation.level_map import LevelMap
from xtdrone_planning.navigation.settings import WindowSettings

Array = NDArray[np.float64]

_SPEEDS, _RATES = 7, 21  # samples of the window
_AT_TARGET = 0.1  # m: closer than this, the direction to the target is undefined
_COMFORT = 0.4  # m beyond the radius within which clearance counts


class Motion(NamedTuple):
    """A command: speed ahead, m/s, and yaw rate, rad/s, counter-clockwise."""

    speed: float
    rate: float


AT_REST = Motion(0.0, 0.0)


def window(settings: WindowSettings, present: Motion, most: float, turn: float) -> tuple[Array, Array]:
    """Return the speeds and yaw rates that can be reached within one cycle, standstill included if reachable.

    Args:
        settings: limits.
        present: the last command.
        most: maximum speed now, m/s.
        turn: duration of a cycle, s.
    """
    low, high = _reach(present.speed, settings.acceleration * turn, 0.0, min(most, settings.speed))
    left, right = _reach(present.rate, settings.turn_acceleration * turn, -settings.turn_rate, settings.turn_rate)
    rates = np.linspace(left, right, _RATES)
    if left <= 0.0 <= right:
        rates[np.argmin(np.abs(rates))] = 0.0
    return np.linspace(low, high, _SPEEDS), rates


def _reach(value: float, change: float, low: float, high: float) -> tuple[float, float]:
    """Return the lowest and highest reachable value; if the limits cannot be reached, the closest values."""
    return min(max(low, value - change), value + change), max(min(high, value + change), value - change)


def brake(settings: WindowSettings, present: Motion, turn: float) -> Motion:
    """Return the motion after braking for one cycle, s."""
    slower = max(0.0, abs(present.speed) - settings.acceleration * turn)
    steadier = max(0.0, abs(present.rate) - settings.turn_acceleration * turn)
    return Motion(math.copysign(slower, present.speed), math.copysign(steadier, present.rate))


def choose(
    level: LevelMap, settings: WindowSettings, pose: Array, present: Motion, path: Array, most: float, turn: float
) -> Motion | None:
    """Return the best motion along a path, or None if no motion is admissible.

    Args:
        level: the map, with distances up to date around the vehicle.
        settings: limits and weights.
        pose: (3,) x, y, m in map, and yaw, rad.
        present: the last command.
        path: (n, 2) of the global plan, m in map.
        most: maximum speed now, m/s.
        turn: duration of a cycle, s.
    """
    clearance = settings.radius + 0.5 * level.cell
    nearest, target = target_on_path(
        level.distance, level.corner, level.cell, path, pose[0], pose[1], settings.ahead, clearance
    )
    ahead = path[max(0, nearest - 5) : target + 1]
    speeds, rates = window(settings, present, most, turn)
    weights = np.array(
        [
            settings.heading_bias,
            settings.progress_bias,
            settings.path_bias,
            settings.clearance_bias,
            settings.speed_bias / settings.speed,
        ]
    )
    found, speed, rate = best_motion(
        level.distance, level.corner, level.cell, np.asarray(pose, float), speeds, rates, settings.horizon,
        settings.acceleration, clearance, ahead, path[target], weights,
    )  # fmt: skip
    return Motion(float(speed), float(rate)) if found else None


def arc(pose: Array, motion: Motion, duration: float, count: int) -> Array:
    """Return the poses (count, 3), x, y, m, yaw, rad, along a motion, evenly spaced over a duration, s."""
    found = np.empty((count, 3))
    for n in range(count):
        found[n] = move_along_arc(pose[0], pose[1], pose[2], motion.speed, motion.rate, duration * (n + 1) / count)
    return found


@kernel
def move_along_arc(x, y, yaw, speed, rate, time):
    """Return the pose after a time, s, on the arc of speed, m/s, and yaw rate, rad/s."""
    half = 0.5 * rate * time
    way = speed * time
    if abs(half) > 1e-6:
        way *= math.sin(half) / half
    return x + way * math.cos(yaw + half), y + way * math.sin(yaw + half), yaw + rate * time


@kernel
def _away(distance, corner, cell, x, y):
    """Return the distance from a point to the nearest obstacle, m; outside the map, 0."""
    nx, ny, _ = distance.shape
    i, j = math.floor(x / cell) - corner[0], math.floor(y / cell) - corner[1]
    if 0 <= i < nx and 0 <= j < ny:
        return distance[i, j, 0]
    return 0.0


@kernel
def target_on_path(distance, corner, cell, path, x, y, ahead, clearance):
    """Return the nearest point of a path, and the target point: at most ``ahead`` m further, with a clear line to it.

    Args:
        distance, corner, cell: the map.
        path: (n, 2) m.
        x, y: of the vehicle, m.
        ahead: m along the path.
        clearance: minimum distance of the line to obstacles, m.

    Returns:
        (nearest, target), indices of points.
    """
    nearest, least = 0, math.inf
    for n in range(len(path)):
        off = (path[n, 0] - x) ** 2 + (path[n, 1] - y) ** 2
        if off < least:
            nearest, least = n, off
    target = min(nearest + 1, len(path) - 1)
    way = 0.0
    for n in range(nearest + 1, len(path)):
        way += math.hypot(path[n, 0] - path[n - 1, 0], path[n, 1] - path[n - 1, 1])
        if way > ahead or not _line_is_free(distance, corner, cell, x, y, path[n, 0], path[n, 1], clearance):
            break
        target = n
    return nearest, target


@kernel
def _line_is_free(distance, corner, cell, x, y, a, b, clearance):
    """Return whether a straight line keeps its clearance to obstacles; near its start the clearance may be less."""
    length = math.hypot(a - x, b - y)
    steps = max(1, math.ceil(2.0 * length / cell))
    for n in range(1, steps + 1):
        part = n / steps
        away = _away(distance, corner, cell, x + part * (a - x), y + part * (b - y))
        if part * length > clearance and away < clearance:
            return False
    return True


@kernel
def _path_distance(path, x, y):
    """Return the distance of a point to the nearest segment of a path (n, 2), m."""
    least = (path[0, 0] - x) ** 2 + (path[0, 1] - y) ** 2
    for n in range(1, len(path)):
        u, v = path[n, 0] - path[n - 1, 0], path[n, 1] - path[n - 1, 1]
        square = u * u + v * v
        part = 0.0
        if square > 0.0:
            part = min(1.0, max(0.0, ((x - path[n - 1, 0]) * u + (y - path[n - 1, 1]) * v) / square))
        least = min(least, (path[n - 1, 0] + part * u - x) ** 2 + (path[n - 1, 1] + part * v - y) ** 2)
    return math.sqrt(least)


@kernel
def _nearness(distance, corner, cell, pose, speed, rate, duration, clearance):
    """Return the minimum distance to obstacles along a motion, m; negative if the motion is not admissible.

    A vehicle that is too close to an obstacle may keep that distance or move away.
    """
    steps = max(1, math.ceil(2.0 * speed * duration / cell))
    least = math.inf
    before = _away(distance, corner, cell, pose[0], pose[1])
    for n in range(1, steps + 1):
        x, y, _ = move_along_arc(pose[0], pose[1], pose[2], speed, rate, duration * n / steps)
        now = _away(distance, corner, cell, x, y)
        if now < clearance and now < before:
            return -1.0
        before = min(clearance, now)
        least = min(least, now)
    return least


@kernel
def best_motion(
    distance, corner, cell, pose, speeds, rates, horizon, acceleration, clearance, path, target, weights
):  # fmt: skip
    """Return the admissible motion with the largest value.

    Args:
        distance, corner, cell: the map.
        pose: (3,) x, y, m, yaw, rad.
        speeds, rates: of the window, m/s and rad/s.
        horizon: s; a motion is checked for longer if stopping takes longer.
        acceleration: Acceleration of braking, m/s^2.
        clearance: minimum distance to obstacles, m.
        path: (n, 2) m, n at least 1.
        target: (2,) m.
        weights: Weights of heading, progress, distance to the path (1/m), clearance and speed (s/m).

    Returns:
        (found, speed, rate).
    """
    best, best_speed, best_rate, found = -math.inf, 0.0, 0.0, False
    before = math.hypot(target[0] - pose[0], target[1] - pose[1])
    reach = max(speeds[len(speeds) - 1] * horizon, 1e-3)
    for speed in speeds:
        for rate in rates:
            near = _nearness(
                distance, corner, cell, pose, speed, rate, max(horizon, speed / acceleration), clearance
            )  # fmt: skip
            if near < 0.0:
                continue
            x, y, yaw = move_along_arc(pose[0], pose[1], pose[2], speed, rate, horizon)
            u, v = target[0] - x, target[1] - y
            rest = math.hypot(u, v)
            heading = 1.0
            if rest > _AT_TARGET:
                off = (math.atan2(v, u) - yaw + math.pi) % (2.0 * math.pi) - math.pi
                heading = 1.0 - abs(off) / math.pi
            value = (
                weights[0] * heading
                + weights[1] * (before - rest) / reach
                - weights[2] * _path_distance(path, x, y)
                + weights[3] * min(1.0, max(0.0, near - clearance) / _COMFORT)
                + weights[4] * speed
            )
            if value > best:
                best, best_speed, best_rate, found = value, speed, rate, True
    return found, best_speed, best_rate
