"""Safety filter: closest velocity to the desired one with which a vehicle stays clear of others and of obstacles."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.kernel import kernel
from xtdrone_planning.safety.barriers import obstacle_barrier, vehicle_barrier
from xtdrone_planning.safety.half_spaces import nearest
from xtdrone_planning.safety.near_points import SECTORS, nearest_by_sector
from xtdrone_planning.safety.settings import SafetySettings

MARGIN = 0.2  # m, added to the distance between vehicles: covers the residual of the lag after two have braked
_TURN_LEAST, _TURN_MOST = 0.2, 1.8  # rad
_TURN_RATE = 4.0  # rad/s
_BLOCKED = 0.3  # fraction of the desired velocity below which a vehicle counts as blocked
_WEIGHT_LEAST = 0.1  # weight of constraints at or below the minimum distance, when not all can be satisfied
_NOTHING = -1
_NO_POINTS = np.empty((0, 3))


class Verdict(NamedTuple):
    """Result of the filter.

    Attributes:
        velocity: allowed velocity, shape (3,), m/s; the desired one if it is allowed.
        corrected: whether it differs from the desired one.
        nearest: distance of the nearest vehicle or obstacle, m; infinite if there is none within range.
        cause: index of the vehicle that restricts the desired velocity most, -1: none or an obstacle.
        excess: velocity by which the limits had to be exceeded, m/s; 0 if all are satisfied.
    """

    velocity: NDArray[np.float64]
    corrected: bool
    nearest: float
    cause: int
    excess: float


class VelocityFilter:
    """The safety filter of one vehicle.

    Vehicles that block each other give way to the right: the longer the desired velocity is blocked, the further it is
    rotated clockwise, seen from above. A group that meets in one place circulates like cars on a roundabout.
    """

    def __init__(self, settings: SafetySettings, period: float) -> None:
        """Create a filter that is called every ``period`` seconds."""
        self._settings = settings
        self._period = period
        self._turn = np.full(1, _TURN_LEAST)
        self._near = np.empty((SECTORS, 3))

    def restart(self) -> None:
        """Reset to the initial state."""
        self._turn[0] = _TURN_LEAST

    def check(
        self,
        wanted: NDArray[np.float64],
        position: NDArray[np.float64],
        others: NDArray[np.float64],
        velocities: NDArray[np.float64],
        obstacles: NDArray[np.float64] = _NO_POINTS,
        agreed: NDArray[np.bool_] | None = None,
        *,
        is_clear: bool = False,
    ) -> Verdict:
        """Return the allowed velocity.

        Args:
            wanted: velocity, shape (3,), m/s ENU.
            position: of this vehicle, shape (3,), m ENU.
            others: positions of the other vehicles, shape (N, 3), m ENU; NaN where unknown.
            velocities: of these, shape (N, 3), m/s ENU.
            obstacles: points, shape (K, 3), m ENU.
            agreed: shape (N,), the vehicles that fly on trajectories which keep clear of this one's; none by default.
            is_clear: whether this vehicle's trajectory is clear of the points.
        """
        s = self._settings
        no_barrier = np.zeros(len(others), dtype=np.bool_) if agreed is None else agreed
        result = np.empty(3)
        corrected, distance, cause, excess = _checked(
            wanted, position, others, velocities, obstacles, no_barrier, is_clear, s.distance + MARGIN,
            s.obstacle_distance, s.lag, s.deceleration, s.max_speed, s.range,
            _TURN_RATE * self._period, self._turn, self._near, result,
        )  # fmt: skip
        return Verdict(result, bool(corrected), float(distance), int(cause), float(excess))


@kernel
def _checked(
    wanted, position, others, velocities, obstacles, agreed, is_clear, distance, obstacle_distance, lag, deceleration,
    max_speed, reach, turn_step, turn, near, result,
):  # fmt: skip
    """Store the allowed velocity; return whether it was corrected, nearest distance, cause and excess."""
    points = nearest_by_sector(obstacles, position, reach, near)
    normals = np.empty((len(others) + points, 3))
    offsets = np.empty(len(others) + points)
    weights = np.empty(len(others) + points)
    count, closest, cause, most = 0, math.inf, _NOTHING, 0.0
    blocked_by_vehicle = False
    for k in range(len(others) + points):
        if k < len(others):
            if not math.isfinite(others[k, 0] + others[k, 1] + others[k, 2]):
                continue
            offset, away = vehicle_barrier(
                position, others[k], velocities[k], distance, lag, deceleration, normals[count]
            )
        else:
            offset, away = obstacle_barrier(
                position, near[k - len(others)], obstacle_distance, lag, deceleration, normals[count]
            )
        if away > reach:
            continue
        closest = min(closest, away)
        if agreed[k] if k < len(others) else is_clear:
            continue
        offsets[count] = offset
        least = distance if k < len(others) else obstacle_distance
        weights[count] = min(max((away - least) / least, _WEIGHT_LEAST), 1.0)
        missing = offset - _dot(normals[count], wanted)
        if missing > 0.0:
            blocked_by_vehicle = blocked_by_vehicle or k < len(others)
            if missing > most:
                most, cause = missing, k if k < len(others) else _NOTHING
        count += 1
    speed = math.sqrt(_dot(wanted, wanted))
    if most == 0.0:
        result[:] = wanted
        turn[0] = max(_TURN_LEAST, turn[0] - turn_step)
        return False, closest, _NOTHING, 0.0
    aim = wanted.copy()
    if blocked_by_vehicle:
        cosine, sine = math.cos(turn[0]), math.sin(turn[0])
        aim[0], aim[1] = cosine * wanted[0] + sine * wanted[1], cosine * wanted[1] - sine * wanted[0]
    excess = nearest(normals, offsets, weights, count, aim, max_speed, result)
    blocked = blocked_by_vehicle and _dot(result, wanted) < _BLOCKED * speed * min(speed, max_speed)
    turn[0] = min(_TURN_MOST, turn[0] + turn_step) if blocked else max(_TURN_LEAST, turn[0] - turn_step)
    return True, closest, cause, excess


@kernel
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
