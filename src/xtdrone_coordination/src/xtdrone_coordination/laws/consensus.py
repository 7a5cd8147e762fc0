"""The consensus laws, equation 2 of the paper.

Velocity form, with x the position xi and d the formation offset delta:

    u_i = -k_i sum_j w_ij ((x_i - d_i) - (x_j - d_j))

Acceleration form, with the velocities v and damping gamma:

    u_i = -k_i sum_j w_ij ((x_i - d_i) - (x_j - d_j) + gamma (v_i - v_j))

k_i is the gain Kp divided by vehicle i's in-degree sum_j w_ij, as XTDrone does, or Kp itself (``normalise=False``, the
paper's equation with w in {0, 1}). With gamma = 2 / sqrt(Kp) the normalised acceleration form is critically damped.

``lead``, ``attraction``, ``scaled`` and ``clip`` are also compiled for many followers: they call no other function.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

Vector = tuple[float, float, float]


class Peer(NamedTuple):
    """A neighbour as a follower knows it.

    Attributes:
        id: number of the neighbour.
        weight: w_ij > 0.
        position: m, ENU, in the frame all vehicles share.
        velocity: m/s, ENU.
        offset: its slot relative to the leader, m, ENU.
    """

    id: int
    weight: float
    position: Vector
    velocity: Vector
    offset: Vector


def velocity_law(
    position: Vector, offset: Vector, peers: Iterable[Peer], gain: float, *, normalise: bool = True
) -> Vector:
    """Return u_i of one vehicle in the velocity form, m/s; zero without neighbours.

    Args:
        position: own position, m ENU.
        offset: own slot relative to the leader, m ENU.
        peers: its neighbours.
        gain: Kp, 1/s.
        normalise: whether to divide by the in-degree.
    """
    x = y = z = degree = 0.0
    for peer in peers:
        dx, dy, dz = attraction(peer.weight, position, offset, peer.position, peer.offset)
        x, y, z = x + dx, y + dy, z + dz
        degree += peer.weight
    return scaled((x, y, z), degree, gain, normalise)


def acceleration_law(
    position: Vector,
    velocity: Vector,
    offset: Vector,
    peers: Iterable[Peer],
    gain: float,
    gamma: float,
    *,
    normalise: bool = True,
) -> Vector:
    """Return u_i of one vehicle in the acceleration form, m/s^2; zero without neighbours.

    Args:
        position: own position, m ENU.
        velocity: own velocity, m/s ENU.
        offset: own slot relative to the leader, m ENU.
        peers: its neighbours.
        gain: Kp, 1/s^2.
        gamma: damping, s.
        normalise: whether to divide by the in-degree.
    """
    led = [peer._replace(position=lead(peer.position, peer.velocity, gamma)) for peer in peers]
    return velocity_law(lead(position, velocity, gamma), offset, led, gain, normalise=normalise)


def critical_damping(gain: float) -> float:
    """Return gamma = sqrt(4 / Kp) in seconds."""
    return math.sqrt(4.0 / gain)


def lead(position: Vector, velocity: Vector, gamma: float) -> Vector:
    """Return x + gamma v, m: the velocity form applied to it is the acceleration form."""
    x, y, z = position
    vx, vy, vz = velocity
    return x + gamma * vx, y + gamma * vy, z + gamma * vz


def attraction(weight: float, position: Vector, offset: Vector, peer_position: Vector, peer_offset: Vector) -> Vector:
    """Return one neighbour's term of the sum, w_ij ((x_j - d_j) - (x_i - d_i)), m."""
    px, py, pz = position
    dx, dy, dz = offset
    qx, qy, qz = peer_position
    ex, ey, ez = peer_offset
    return (
        weight * ((qx - ex) - (px - dx)),
        weight * ((qy - ey) - (py - dy)),
        weight * ((qz - ez) - (pz - dz)),
    )


def scaled(total: Vector, degree: float, gain: float, normalise: bool) -> Vector:
    """Return the sum of all terms times k_i; zero if the in-degree is zero."""
    if degree == 0.0:
        return 0.0, 0.0, 0.0
    x, y, z = total
    k = gain / degree if normalise else gain
    return k * x, k * y, k * z


def clip(vector: Vector, limit: float) -> Vector:
    """Return ``vector`` shortened to the length ``limit`` if it is longer; its direction stays."""
    x, y, z = vector
    length = math.sqrt(x * x + y * y + z * z)
    if length <= limit:
        return vector
    k = limit / length
    return x * k, y * k, z * k
