"""Collision avoidance between vehicles, Algorithm 1 of the paper, as each vehicle computes it for itself.

For every other vehicle nearer than b, with r from this one to that one, the avoidance velocity grows by

    kp (1 - |r| / b) (r x n) / |r x n|

so two vehicles that meet pass around each other: their contributions are perpendicular to r and opposite.

The paper chooses n between the x and the y axis by the signed products r.n1 < r.n2, which takes the axis parallel to r
for r = (-1, 0, 0) and divides 0 by 0. Here n is the axis with the smaller absolute cosine to r, so |r x n| is at least
|r| / sqrt(2). For two vehicles at the same place r has no direction: the one with the smaller number takes r for the
x axis and the other for the opposite, so they part.

Algorithm 1 turns vehicles around each other but never stops them from closing in, which several at once can do: what
one of them is to be avoided by may lead towards another. So a follower also gives way: of its velocity, consensus and
avoidance together, the part towards a vehicle nearer than b fades out with the square of the way that remains to the
clearance, down to nothing there. It does so twice over all that are near: what the first round takes away for one of
them may turn it towards another. This is ours, not the paper's; clearance 0 switches it off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from xtdrone_coordination.consensus import Vector

RADIUS = 1.5  # m, b
GAIN = 1.0  # m/s, kp
CLEARANCE = 0.7  # m
ROUNDS = 2  # of giving way

_COINCIDENT = 1e-6  # m


def pair(r: Vector, radius: float = RADIUS, gain: float = GAIN, *, first: bool = True) -> Vector:
    """Return one vehicle's contribution against another, m/s; zero beyond the radius.

    Args:
        r: from this vehicle to the other, m.
        radius: b > 0, m.
        gain: kp, m/s.
        first: whether this vehicle has the smaller number; only matters when both are at the same place.
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
    own = positions[index]
    if own is None:
        return 0.0, 0.0, 0.0
    px, py, pz = own
    square = radius * radius
    ax = ay = az = 0.0
    for j, other in enumerate(positions):
        if other is None or j == index:
            continue
        x, y, z = other[0] - px, other[1] - py, other[2] - pz
        if x * x + y * y + z * z < square:
            dx, dy, dz = pair((x, y, z), radius, gain, first=index < j)
            ax, ay, az = ax + dx, ay + dy, az + dz
    return ax, ay, az


def give_way(
    index: int,
    positions: Sequence[Vector | None],
    velocity: Vector,
    radius: float = RADIUS,
    clearance: float = CLEARANCE,
) -> Vector:
    """Return ``velocity`` with less of what leads towards vehicles that are near.

    Args:
        index: this vehicle's number.
        positions: of all vehicles, m ENU in one frame; None where unknown.
        velocity: wanted, m/s ENU.
        radius: b, m: nothing changes beyond it.
        clearance: below ``radius``, m: at this distance nothing remains of the part towards the other vehicle; 0
            returns ``velocity`` as it is.
    """
    own = positions[index]
    if own is None or clearance <= 0.0:
        return velocity
    px, py, pz = own
    vx, vy, vz = velocity
    square = radius * radius
    near = []
    for j, other in enumerate(positions):
        if other is None or j == index:
            continue
        x, y, z = other[0] - px, other[1] - py, other[2] - pz
        distance_square = x * x + y * y + z * z
        if _COINCIDENT**2 < distance_square < square:
            near.append((x, y, z, distance_square))
    for _ in range(ROUNDS):
        for x, y, z, distance_square in near:
            towards = x * vx + y * vy + z * vz
            if towards <= 0.0:
                continue
            remains = max(0.0, (math.sqrt(distance_square) - clearance) / (radius - clearance))
            k = (1.0 - remains * remains) * towards / distance_square
            vx, vy, vz = vx - k * x, vy - k * y, vz - k * z
    return vx, vy, vz
