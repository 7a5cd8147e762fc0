"""The consensus laws, for the whole swarm at once (numpy) and for one vehicle (scalars, for the nodes' hot path).

Velocity form, equation 2 of the paper, with x the position xi and d the formation offset delta:

    u_i = -k_i sum_j w_ij ((x_i - d_i) - (x_j - d_j))

Acceleration form, with the velocities v and damping gamma:

    u_i = -k_i sum_j w_ij ((x_i - d_i) - (x_j - d_j) + gamma (v_i - v_j))

k_i is the gain Kp divided by vehicle i's in-degree sum_j w_ij, as XTDrone does, or Kp itself (``normalise=False``, the
paper's equation with w in {0, 1}). With gamma = 2 / sqrt(Kp) the normalised acceleration form is critically damped.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = tuple[float, float, float]


class Peer(NamedTuple):
    """What one vehicle knows of another that it listens to.

    Attributes:
        id: number of the other vehicle.
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


def critical_damping(gain: float) -> float:
    """Return gamma = sqrt(4 / Kp) in seconds."""
    return math.sqrt(4.0 / gain)


def velocity_law(
    position: Vector, offset: Vector, peers: Iterable[Peer], gain: float, *, normalise: bool = True
) -> Vector:
    """Return u_i in m/s of one vehicle in the velocity form; zero when it listens to nobody.

    Args:
        position: own position, m ENU.
        offset: own slot relative to the leader, m ENU.
        peers: those it listens to.
        gain: Kp, 1/s.
        normalise: whether to divide by the in-degree.
    """
    px, py, pz = position
    dx, dy, dz = offset
    x = y = z = degree = 0.0
    for _, weight, (qx, qy, qz), _, (ex, ey, ez) in peers:
        x += weight * ((qx - ex) - (px - dx))
        y += weight * ((qy - ey) - (py - dy))
        z += weight * ((qz - ez) - (pz - dz))
        degree += weight
    if not degree:
        return 0.0, 0.0, 0.0
    k = gain / degree if normalise else gain
    return k * x, k * y, k * z


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
    """Return u_i in m/s^2 of one vehicle in the acceleration form; zero when it listens to nobody.

    Args:
        position: own position, m ENU.
        velocity: own velocity, m/s ENU.
        offset: own slot relative to the leader, m ENU.
        peers: those it listens to.
        gain: Kp, 1/s^2.
        gamma: damping, s.
        normalise: whether to divide by the in-degree.
    """
    led = [q._replace(position=_lead(q.position, q.velocity, gamma)) for q in peers]
    return velocity_law(_lead(position, velocity, gamma), offset, led, gain, normalise=normalise)


def _lead(position: Vector, velocity: Vector, gamma: float) -> Vector:
    """Return x + gamma v: on it, the acceleration form is the velocity form."""
    x, y, z = position
    vx, vy, vz = velocity
    return x + gamma * vx, y + gamma * vy, z + gamma * vz


def swarm_velocity(
    positions: ArrayLike, offsets: ArrayLike, weights: ArrayLike, gain: float, *, normalise: bool = True
) -> NDArray[np.float64]:
    """Return u of all vehicles in the velocity form, shape (N, 3), m/s.

    Args:
        positions: shape (N, 3), m ENU.
        offsets: shape (N, 3), m ENU, the leader's row zero.
        weights: W, shape (N, N).
        gain: Kp, 1/s.
        normalise: whether to divide by the in-degrees.
    """
    w = np.asarray(weights, dtype=float)
    x = np.asarray(positions, dtype=float) - np.asarray(offsets, dtype=float)
    degree = w.sum(axis=1, keepdims=True)
    u = w @ x - degree * x
    if normalise:
        u /= np.where(degree > 0.0, degree, 1.0)
    return gain * u


def swarm_acceleration(
    positions: ArrayLike,
    velocities: ArrayLike,
    offsets: ArrayLike,
    weights: ArrayLike,
    gain: float,
    gamma: float,
    *,
    normalise: bool = True,
) -> NDArray[np.float64]:
    """Return u of all vehicles in the acceleration form, shape (N, 3), m/s^2; see :func:`swarm_velocity`."""
    lead = np.asarray(positions, dtype=float) + gamma * np.asarray(velocities, dtype=float)
    return swarm_velocity(lead, offsets, weights, gain, normalise=normalise)


def clip(vector: Vector, limit: float) -> Vector:
    """Return ``vector`` shortened to the length ``limit`` if it is longer; its direction stays."""
    x, y, z = vector
    length = math.sqrt(x * x + y * y + z * z)
    if length <= limit:
        return vector
    k = limit / length
    return x * k, y * k, z * k
