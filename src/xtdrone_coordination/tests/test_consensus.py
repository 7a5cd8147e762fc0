"""The consensus laws against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_coordination.laws.consensus import Peer, acceleration_law, clip, critical_damping, velocity_law
from xtdrone_coordination.laws.topology import veteran_topology
from xtdrone_coordination.patterns import Patterns, with_leader


@pytest.fixture
def swarm() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, velocities, offsets and weights of nine vehicles."""
    rng = np.random.default_rng(3)
    offsets = with_leader(Patterns(9).offsets("pyramid"))
    weights = veteran_topology(offsets) * rng.uniform(0.5, 2.0, (9, 9))
    return rng.uniform(-5, 5, (9, 3)), rng.uniform(-1, 1, (9, 3)), offsets, weights


def peers_of(i: int, x: np.ndarray, v: np.ndarray, d: np.ndarray, w: np.ndarray) -> list[Peer]:
    return [Peer(j, w[i, j], tuple(x[j]), tuple(v[j]), tuple(d[j])) for j in range(len(x)) if w[i, j]]


def swarm_velocity(x: np.ndarray, d: np.ndarray, w: np.ndarray, gain: float, *, normalise: bool = True) -> np.ndarray:
    """Return the velocity law of all vehicles, shape (N, 3)."""
    return np.array(
        [
            velocity_law(tuple(x[i]), tuple(d[i]), peers_of(i, x, 0.0 * x, d, w), gain, normalise=normalise)
            for i in range(len(x))
        ]
    )


def swarm_acceleration(
    x: np.ndarray,
    v: np.ndarray,
    d: np.ndarray,
    w: np.ndarray,
    gain: float,
    gamma: float,
    *,
    normalise: bool = True,
) -> np.ndarray:
    """Return the acceleration law of all vehicles, shape (N, 3)."""
    return np.array(
        [
            acceleration_law(
                tuple(x[i]), tuple(v[i]), tuple(d[i]), peers_of(i, x, v, d, w), gain, gamma, normalise=normalise
            )
            for i in range(len(x))
        ]
    )


@pytest.mark.parametrize("normalise", [True, False])
def test_all_vehicles_of_a_swarm_agree_with_the_equation(
    swarm: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], normalise: bool
) -> None:
    x, v, d, w = swarm
    gain, gamma = 0.7, 1.3
    velocity = swarm_velocity(x, d, w, gain, normalise=normalise)
    acceleration = swarm_acceleration(x, v, d, w, gain, gamma, normalise=normalise)
    for i in range(9):
        degree = w[i].sum() if normalise and i else 1.0
        first = -gain / degree * sum(w[i, j] * ((x[i] - d[i]) - (x[j] - d[j])) for j in range(9))
        second = first - gain / degree * gamma * sum(w[i, j] * (v[i] - v[j]) for j in range(9))
        assert velocity[i] == pytest.approx(first)
        assert acceleration[i] == pytest.approx(second)


def test_leader_alone_remains() -> None:
    assert velocity_law((1.0, 2.0, 3.0), (0.0, 0.0, 0.0), [], 1.0) == (0.0, 0.0, 0.0)


def test_chain_converges_as_its_closed_form() -> None:
    """In a chain 0 <- 1 <- 2 the errors are e1 = a exp(-kt), e2 = (b + a k t) exp(-kt)."""
    weights = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    offsets = np.array([[0.0, 0, 0], [2, 0, 0], [4, 0, 0]])
    x = offsets + np.array([[0.0, 0, 0], [1.0, 0, 0], [0.5, 0, 0]])
    k, dt, end = 0.8, 1e-4, 3.0
    for _ in range(round(end / dt)):
        x = x + dt * swarm_velocity(x, offsets, weights, k)
    e = (x - offsets)[:, 0]
    assert e[0] == 0.0
    assert e[1] == pytest.approx(math.exp(-k * end), rel=1e-3)
    assert e[2] == pytest.approx((0.5 + k * end) * math.exp(-k * end), rel=1e-3)


def test_second_order_form_is_critically_damped() -> None:
    """With one neighbour at rest e = (1 + s t) exp(-s t), s = sqrt(Kp)."""
    weights = np.array([[0, 0], [1, 0]])
    offsets = np.array([[0.0, 0, 0], [2, 0, 0]])
    x, v = offsets + np.array([[0, 0, 0], [1, 0, 0]]), np.zeros((2, 3))
    gain, dt, end = 1.5, 1e-4, 2.0
    for _ in range(round(end / dt)):
        v = v + dt * swarm_acceleration(x, v, offsets, weights, gain, critical_damping(gain))
        x = x + dt * v
    s = math.sqrt(gain)
    assert x[1, 0] - 2.0 == pytest.approx((1 + s * end) * math.exp(-s * end), rel=2e-3)


def test_clip_is_continuous_and_keeps_the_direction() -> None:
    assert clip((0.6, 0.0, 0.8), 1.0) == (0.6, 0.0, 0.8)
    assert clip((3.0, 0.0, 4.0), 1.0) == pytest.approx((0.6, 0.0, 0.8))
    assert clip((1.0 + 1e-9, 0.0, 0.0), 1.0) == pytest.approx((1.0, 0.0, 0.0))
