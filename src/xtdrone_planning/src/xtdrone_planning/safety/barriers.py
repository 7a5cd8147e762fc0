"""Half-spaces of velocities that keep a vehicle clear of other vehicles and obstacles.

Control barriers for vehicles that follow a velocity with a lag, after Wang, Ames, Egerstedt, *Safety barrier
certificates for collisions-free multirobot systems*, 2017: the closing speed is at most the one from which the vehicles
can still brake within the remaining distance, after the lag. Each of two vehicles is allotted half of the closing
speed. Standing still is therefore always allowed, unless another vehicle exceeds its half: then this one retreats by
the excess.
"""

from __future__ import annotations

import math

from xtdrone_planning.kernel import kernel

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
        deceleration: of each of the two, m/s^2.
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
