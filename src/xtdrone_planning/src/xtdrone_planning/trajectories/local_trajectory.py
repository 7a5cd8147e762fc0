"""Trajectory along a path: smooth, within the limits, collision-free, and at rest at the path's end.

Since it ends at rest within seen space, the vehicle can follow it to its end even if the planner fails; the idea of J.
Tordesillas et al., FASTER: fast and safe trajectory planner for navigation in unknown environments, IEEE Transactions
on Robotics 38, 2022.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.mapping.voxel_grid import VoxelGrid
from xtdrone_planning.planner_settings import TrajectorySettings
from xtdrone_planning.trajectories.moving_vehicles import NO_VEHICLES, MovingVehicles
from xtdrone_planning.trajectories.separation import first_conflict
from xtdrone_planning.trajectories.speed_profile import SpeedProfile, length_of, points_along
from xtdrone_planning.trajectories.splines.spline_cost import FIXED, SAMPLES, optimise
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline, first_points

Array = NDArray[np.float64]

_INTERVAL = 0.25  # s between knots, as far as the number of segments allows
_FEWEST, _MOST = 6, 40  # segments
_PACES = (1.0, 0.8, 0.6, 0.4)  # fractions of the speed limit, tried in this order
_WEIGHTS = (300.0, 1500.0)  # of the obstacle cost, tried in this order
_STRETCHES = 4  # attempts to slow down until the limits are met
_ITERATIONS = 60
_SLOW_SPEED, _SLOW_ACCELERATION = 0.8, 0.5  # m/s, m/s^2: slow enough to stay close to the path
_SLOW_WAY = 6.0  # m
_AT_REST = 0.05  # m/s
_TOLERANCE = 1e-6
_HEIGHT_TOLERANCE = 0.02  # m: margin for a vertical speed at the start


class State(NamedTuple):
    """Initial state of a trajectory: position, velocity and acceleration, (3,) each, m, m/s, m/s^2 in map."""

    position: Array
    velocity: Array
    acceleration: Array


def plan_along(
    grid: VoxelGrid,
    corners: Array,
    state: State,
    time: float,
    settings: TrajectorySettings,
    others: MovingVehicles = NO_VEHICLES,
    heights: tuple[float, float] = (-math.inf, math.inf),
) -> UniformSpline | None:
    """Return a trajectory along a path, or None if no attempt meets all limits.

    Args:
        grid: the map.
        corners: (n, 3) path, which begins at the state's position, m.
        state: State at the start.
        time: Time of the start, s of ROS time.
        settings: limits.
        others: vehicles to avoid.
        heights: minimum and maximum flight height, m in map; a trajectory that starts outside may return.
    """
    length = length_of(corners)
    if len(corners) < 2 or length < _TOLERANCE:
        return None
    ahead = corners[1] - corners[0]
    height = float(state.position[2])  # within the tolerance the limits are kept, so that successive plans do not sink
    heights = (
        heights[0] if height >= heights[0] - _HEIGHT_TOLERANCE else height,
        heights[1] if height <= heights[1] + _HEIGHT_TOLERANCE else height,
    )
    speed = max(0.0, float(state.velocity @ ahead) / max(float(np.linalg.norm(ahead)), _TOLERANCE))
    for pace in _PACES:
        law = SpeedProfile.along(length, speed, pace * settings.speed, 0.7 * pace * settings.acceleration)
        segments = int(np.clip(math.ceil(law.duration / _INTERVAL) + 2, _FEWEST, _MOST))
        interval = max(law.duration / (segments - 2), 0.05)
        reference = points_along(corners, law.way((np.arange(segments + 3) - 1.0) * interval))
        for weight in _WEIGHTS:
            spline = _attempt(grid, reference, interval, state, time, weight, settings, others, heights)
            if spline is None or not is_flyable(grid, spline, time, settings):
                continue
            if math.isinf(others.conflict_time(spline, time)):
                return spline
    return _slowly_along(grid, corners, length, state, time, settings, others)


def _slowly_along(
    grid: VoxelGrid,
    corners: Array,
    length: float,
    state: State,
    time: float,
    settings: TrajectorySettings,
    others: MovingVehicles,
) -> UniformSpline | None:
    """Return a slow trajectory from rest whose control points are on the path itself, or None if it is not flyable.

    The optimisation may end in a local minimum inside an obstacle; a spline stays in the convex hull of its control
    points, and hence, at low speed, close to the collision-free path.
    """
    if float(np.linalg.norm(state.velocity)) > _AT_REST:
        return None
    speed, acceleration = min(_SLOW_SPEED, settings.speed), min(_SLOW_ACCELERATION, settings.acceleration)
    law = SpeedProfile.along(min(length, _SLOW_WAY), 0.0, speed, acceleration)
    count = math.ceil(law.duration / _INTERVAL) + 1
    ways = np.concatenate([np.zeros(2), law.way(np.arange(count) * _INTERVAL), np.full(2, law.length)])
    spline = UniformSpline(time, _INTERVAL, points_along(corners, ways))
    clear = is_flyable(grid, spline, time, settings) and math.isinf(others.conflict_time(spline, time))
    return spline if clear else None


def is_flyable(grid: VoxelGrid, spline: UniformSpline, time: float, settings: TrajectorySettings) -> bool:
    """Return whether a trajectory is clear and seen from a time, s, onwards; the limits are not checked."""
    return math.isinf(conflict_time(grid, spline, time, settings))


def conflict_time(
    grid: VoxelGrid, spline: UniformSpline, time: float, settings: TrajectorySettings, *, unknown: bool = True
) -> float:
    """Return the ROS time, s, at which a trajectory hits an obstacle or enters unseen space; inf if never.

    Args:
        grid: the map.
        spline: the trajectory.
        time: start of the check, s.
        settings: the vehicle's size.
        unknown: whether unseen space counts as a conflict.
    """
    clearance = settings.radius + 0.5 * grid.resolution
    found = first_conflict(
        spline.points, spline.interval, max(0.0, time - spline.start), grid.distance, grid.evidence, grid.corner,
        grid.resolution, clearance, settings.radius if unknown else -1.0, 2.0 * settings.radius,
    )  # fmt: skip
    return spline.start + float(found)


def _attempt(
    grid: VoxelGrid,
    reference: Array,
    interval: float,
    state: State,
    time: float,
    weight: float,
    settings: TrajectorySettings,
    others: MovingVehicles,
    heights: tuple[float, float],
) -> UniformSpline | None:
    """Return the optimised spline, slowed to its limits; None if it cannot meet them.

    A spline stays in the convex hull of its control points, so the free ones are kept within the heights. The first
    three follow from the initial state; whether the spline leaves the heights there is computed exactly.
    """
    points = reference.copy()
    points[-3:] = reference[-1]
    comfort = settings.clearance(grid.resolution) + settings.comfort
    most_speed = max(settings.speed, float(np.linalg.norm(state.velocity))) + _TOLERANCE
    most_acceleration = max(settings.acceleration, float(np.linalg.norm(state.acceleration))) + _TOLERANCE
    for _ in range(_STRETCHES):
        points[:3] = first_points(state.position, state.velocity, state.acceleration, interval)
        samples = time + np.arange((len(points) - 3) * SAMPLES) * (interval / SAMPLES)
        optimise(
            points, interval, reference, grid.distance, grid.corner, grid.resolution, comfort, weight,
            0.97 * settings.speed, 0.92 * settings.acceleration, others.places(samples),
            others.apart, _ITERATIONS,
        )  # fmt: skip
        np.clip(points[FIXED:-FIXED, 2], *heights, out=points[FIXED:-FIXED, 2])
        spline = UniformSpline(time, interval, points)
        lowest, highest = spline.heights()
        if lowest < heights[0] - _HEIGHT_TOLERANCE or highest > heights[1] + _HEIGHT_TOLERANCE:
            return None  # another attempt follows
        excess = max(
            spline.greatest_speed() / most_speed, math.sqrt(spline.greatest_acceleration() / most_acceleration)
        )
        if excess <= 1.0:
            return spline
        interval *= min(1.3, 1.01 * excess)
    return None
