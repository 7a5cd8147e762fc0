"""Safety filter: closest velocity to the desired one with which a vehicle stays clear of others and of obstacles.

Control barriers for vehicles that follow a velocity with a lag, after Wang, Ames, Egerstedt, *Safety barrier
certificates for collisions-free multirobot systems*, 2017: the closing speed is at most the one from which the vehicles
can still brake within the remaining distance, after the lag. Each of two vehicles is allotted half of the closing
speed. Standing still is therefore always allowed, unless another vehicle exceeds its half: then this one retreats by
the excess.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.settings import Settings, setting
from xtdrone_planning.kernel import kernel
from xtdrone_planning.safety.half_spaces import nearest
from xtdrone_planning.safety.near_points import SECTORS, nearest_by_sector


@dataclass(frozen=True)
class SafetySettings(Settings):
    """Distances, limits and sources of the safety filter.

    The defaults of ``lag`` and ``deceleration`` are those of a vehicle with PX4's default gains, whose horizontal
    velocity follows its setpoint with a time constant of 0.55 s, delayed by one tick of the filter and one of the
    simulator.
    """

    distance: float = setting(
        1.5, low=0.3, high=20.0, unit="m", text="minimum distance between the centres of two vehicles"
    )
    obstacle_distance: float = setting(
        1.0, low=0.2, high=20.0, unit="m", text="minimum distance from the vehicle's centre to a point of an obstacle"
    )
    deceleration: float = setting(
        1.5, low=0.2, high=10.0, unit="m/s^2", text="deceleration that every vehicle can achieve"
    )
    lag: float = setting(1.0, low=0.1, high=5.0, unit="s", text="delay before a vehicle begins to brake")
    max_speed: float = setting(5.0, low=0.2, high=20.0, unit="m/s", text="maximum speed of a corrected setpoint")
    kp: float = setting(
        0.95, low=0.05, high=5.0, unit="1/s", text="speed per position error of a position setpoint (MPC_XY_P)"
    )
    tracking: float = setting(
        0.5, low=0.0, high=5.0, unit="m",
        text="deviation from its trajectory on /VEHICLE/planner/trajectory up to which a vehicle follows it; 0: "
        "trajectories are ignored",
    )  # fmt: skip
    range: float = setting(20.0, low=1.0, high=200.0, unit="m", text="range of vehicles and obstacles that count")
    timeout: float = setting(
        0.5, low=0.05, high=10.0, unit="s", text="age beyond which a position or a cloud is reported as outdated"
    )
    cloud: str = setting(
        "",
        text="topic of a PointCloud2 with obstacles, below the vehicle's name, e.g. ``velodyne_points``; empty: none",
    )
    mount: tuple[float, float, float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0), low=-10.0, high=10.0,
        text="pose of the cloud's frame in the body frame (FLU): x, y, z, roll, pitch, yaw, m and rad",
    )  # fmt: skip


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
            position: Position of this vehicle, shape (3,), m ENU.
            others: positions of the other vehicles, shape (N, 3), m ENU; NaN where unknown.
            velocities: Velocities of these, shape (N, 3), m/s ENU.
            obstacles: points, shape (K, 3), m ENU.
            agreed: shape (N,), the vehicles that fly on trajectories which keep clear of this one's; none by default.
            is_clear: whether this vehicle's trajectory is clear of the points.
        """
        s = self._settings
        no_barrier = np.zeros(len(others), dtype=np.bool_) if agreed is None else agreed
        result = np.empty(3)
        corrected, distance, cause, excess = _check_velocity(
            wanted, position, others, velocities, obstacles, no_barrier, is_clear, s.distance + MARGIN,
            s.obstacle_distance, s.lag, s.deceleration, s.max_speed, s.range,
            _TURN_RATE * self._period, self._turn, self._near, result,
        )  # fmt: skip
        return Verdict(result, bool(corrected), float(distance), int(cause), float(excess))


@kernel
def _check_velocity(
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


_TINY = 1e-9


@kernel
def approach_speed(distance, lag, deceleration):
    """Return the maximum closing speed (m/s); negative (a retreat within the lag) if the distance is negative.

    Args:
        distance: remaining distance, m.
        lag: time until braking begins, s, above 0.
        deceleration: when braking, m/s^2, above 0.
    """
    if distance <= 0.0:
        return distance / lag
    reach = deceleration * lag
    return math.sqrt(reach * reach + 2.0 * deceleration * distance) - reach


@kernel
def away_from(place, other, normal):
    """Store the unit vector from ``other`` to ``place`` (upwards if they coincide); return their distance in m."""
    x, y, z = place[0] - other[0], place[1] - other[1], place[2] - other[2]
    distance = math.sqrt(x * x + y * y + z * z)
    if distance < _TINY:
        normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
        return 0.0
    normal[0], normal[1], normal[2] = x / distance, y / distance, z / distance
    return distance


@kernel
def vehicle_barrier(place, other, other_velocity, least, lag, deceleration, normal):
    """Store the direction away from another vehicle; return the minimum velocity along it, and the distance.

    Args:
        place, other: centres of the vehicles, shape (3,), m.
        other_velocity: shape (3,), m/s.
        least: distance that must be kept, m.
        lag: s.
        deceleration: Deceleration of each of the two, m/s^2.
        normal: shape (3,); written.
    """
    distance = away_from(place, other, normal)
    half = 0.5 * approach_speed(distance - least, lag, 2.0 * deceleration)
    coming = normal[0] * other_velocity[0] + normal[1] * other_velocity[1] + normal[2] * other_velocity[2]
    return max(0.0, coming - half) + min(0.0, coming) - half, distance


@kernel
def obstacle_barrier(place, other, least, lag, deceleration, normal):
    """Store the direction away from a point of an obstacle; return the minimum velocity along it, and the distance.

    Args: see ``vehicle_barrier``.
    """
    distance = away_from(place, other, normal)
    return -approach_speed(distance - least, lag, deceleration), distance
