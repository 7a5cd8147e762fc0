"""Collision avoidance between vehicles, Algorithm 1 of the paper, as computed by each vehicle.

For every other vehicle nearer than b, with r from this one to that one, the avoidance velocity grows by

    kp (1 - |r| / b) (r x n) / |r x n|

so two vehicles that meet pass around each other: their contributions are perpendicular to r and opposite.

The paper chooses n between the x and the y axis by the signed products r.n1 < r.n2, which takes the axis parallel to r
for r = (-1, 0, 0) and divides 0 by 0. Here n is the axis with the smaller absolute cosine to r, so |r x n| is at least
|r| / sqrt(2). For coincident vehicles r has no direction: the one with the smaller number uses the x axis and the other
the opposite, so they separate.

Algorithm 1 turns vehicles around each other but does not stop them from closing in, which happens when avoiding one
vehicle leads towards another. Therefore a follower also gives way: the component of its velocity (consensus plus
avoidance) towards a vehicle nearer than b fades out with the square of the remaining distance to the clearance, and is
zero at the clearance. Two rounds over all near vehicles are made, because removing the component towards one of them
may turn the velocity towards another. This is an addition to the paper; clearance 0 disables it.

``contribution`` and ``yielding`` are also compiled for many followers: they call no other function.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from xtdrone_coordination.laws.consensus import Vector

Near = list[tuple[int, Vector]]
"""Near vehicles: number, and position relative to this vehicle, m."""

RADIUS = 1.5  # m, b
GAIN = 1.0  # m/s, kp
CLEARANCE = 0.7  # m
ROUNDS = 2  # of giving way

_COINCIDENT = 1e-6  # m
_COINCIDENT_SQUARE = _COINCIDENT**2


def avoid(
    index: int,
    positions: Sequence[Vector | None],
    radius: float = RADIUS,
    gain: float = GAIN,
) -> Vector:
    """Return the avoidance velocity of vehicle ``index``, m/s ENU, zero while its own position is unknown.

    Args:
        index: this vehicle's number.
        positions: of all vehicles, m ENU in one frame; None where unknown.
        radius: b > 0, m.
        gain: kp, m/s.
    """
    return avoid_near(index, near_vehicles(index, positions, radius), radius, gain)


def avoid_near(index: int, near: Near, radius: float = RADIUS, gain: float = GAIN) -> Vector:
    """Return the avoidance velocity of vehicle ``index``, see :func:`avoid`, from the :func:`near_vehicles`."""
    ax = ay = az = 0.0
    for j, r in near:
        dx, dy, dz = contribution(r, radius, gain, index < j)
        ax, ay, az = ax + dx, ay + dy, az + dz
    return ax, ay, az


def give_way(
    index: int,
    positions: Sequence[Vector | None],
    velocity: Vector,
    radius: float = RADIUS,
    clearance: float = CLEARANCE,
) -> Vector:
    """Return ``velocity`` with its components towards near vehicles reduced.

    Args:
        index: this vehicle's number.
        positions: of all vehicles, m ENU in one frame; None where unknown.
        velocity: wanted, m/s ENU.
        radius: b, m: vehicles beyond it are ignored.
        clearance: below ``radius``, m: at this distance the component towards the other vehicle is zero; 0 returns
            ``velocity`` unchanged.
    """
    if clearance <= 0.0:
        return velocity
    return give_way_to(near_vehicles(index, positions, radius), velocity, radius, clearance)


def give_way_to(near: Near, velocity: Vector, radius: float = RADIUS, clearance: float = CLEARANCE) -> Vector:
    """Return ``velocity`` reduced towards the :func:`near_vehicles`, see :func:`give_way`; ``clearance`` above 0."""
    if not near:
        return velocity
    for _ in range(ROUNDS):
        for _, r in near:
            velocity = yielding(r, velocity, radius, clearance)
    return velocity


def contribution(r: Vector, radius: float = RADIUS, gain: float = GAIN, first: bool = True) -> Vector:
    """Return the contribution of one other vehicle to the avoidance velocity, m/s; zero beyond the radius.

    Args:
        r: from this vehicle to the other, m.
        radius: b > 0, m.
        gain: kp, m/s.
        first: whether this vehicle has the smaller number; only matters for coincident vehicles.
    """
    x, y, z = r
    distance = math.sqrt(x * x + y * y + z * z)
    if not distance < radius:
        return 0.0, 0.0, 0.0
    if distance < _COINCIDENT:
        x, y, z = (1.0 if first else -1.0), 0.0, 0.0
    if abs(x) < abs(y):
        ax, ay, az = 0.0, z, -y  # r x (1, 0, 0)
    else:
        ax, ay, az = -z, 0.0, x  # r x (0, 1, 0)
    k = gain * (1.0 - distance / radius) / math.sqrt(ax * ax + ay * ay + az * az)
    return k * ax, k * ay, k * az


def yielding(r: Vector, velocity: Vector, radius: float, clearance: float) -> Vector:
    """Return ``velocity`` with its component towards one near vehicle reduced, m/s.

    Args:
        r: from this vehicle to the other, m; shorter than ``radius``.
        velocity: m/s.
        radius: b, m.
        clearance: below ``radius``, m.
    """
    x, y, z = r
    vx, vy, vz = velocity
    square = x * x + y * y + z * z
    towards = x * vx + y * vy + z * vz
    if towards <= 0.0 or square <= _COINCIDENT_SQUARE:
        return velocity
    remains = (math.sqrt(square) - clearance) / (radius - clearance)
    if not remains > 0.0:
        remains = 0.0
    k = (1.0 - remains * remains) * towards / square
    return vx - k * x, vy - k * y, vz - k * z


def near_vehicles(index: int, positions: Sequence[Vector | None], radius: float) -> Near:
    """Return number and relative position (m) of each known vehicle within ``radius`` of vehicle ``index``."""
    own = positions[index]
    if own is None:
        return []
    px, py, pz = own
    square = radius * radius
    near = []
    for j, other in enumerate(positions):
        if other is None or j == index:
            continue
        x, y, z = other
        x, y, z = x - px, y - py, z - pz
        if x * x + y * y + z * z < square:
            near.append((j, (x, y, z)))
    return near
