"""The safety filter without ROS: solver, barriers, and groups of vehicles that exchange positions."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import minimize

from xtdrone_planning.safety.half_spaces import nearest
from xtdrone_planning.safety.near_points import SECTORS, nearest_by_sector, place_points
from xtdrone_planning.safety.velocity_filter import SafetySettings, VelocityFilter, approach_speed

RATE = 30
TIME_CONSTANT, DELAY = 0.55, 3  # s, turns: of a PX4 vehicle's velocity behind its setpoint
ACCELERATION = 5.0  # m/s^2
SPEED = 3.0  # m/s


def unit_vectors(generator, count):
    vectors = generator.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(20))
def test_the_nearest_velocity_is_that_of_a_general_solver(seed):
    generator = np.random.default_rng(seed)
    normals, wanted = unit_vectors(generator, 12), generator.normal(0.0, 3.0, 3)
    offsets = generator.uniform(-2.0, 0.3, 12)
    found = np.empty(3)
    moved = nearest(normals, offsets, np.ones(12), 12, wanted, 4.0, found)
    general = minimize(
        lambda v: np.sum((v - wanted) ** 2),
        np.zeros(3),
        jac=lambda v: 2.0 * (v - wanted),
        constraints=[
            {"type": "ineq", "fun": lambda v: normals @ v - offsets + moved, "jac": lambda v: normals},
            {"type": "ineq", "fun": lambda v: 16.0 - v @ v, "jac": lambda v: -2.0 * v},
        ],
        options={"ftol": 1e-12},
    )
    assert np.min(normals @ found - offsets) >= -moved - 1e-6
    assert np.linalg.norm(found) <= 4.0 + 1e-9
    assert np.linalg.norm(found - wanted) <= np.linalg.norm(general.x - wanted) + 1e-5


def test_half_spaces_without_a_common_point_are_moved_equally():
    normals = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    found = np.empty(3)
    moved = nearest(normals, np.array([1.0, 2.0]), np.array([1.0, 1.0]), 2, np.array([0.0, 1.0, 0.0]), 5.0, found)
    assert moved == pytest.approx(1.5, abs=1e-6)  # x >= 1 and x <= -2 become x >= -0.5 and x <= -0.5
    assert found == pytest.approx([-0.5, 1.0, 0.0], abs=1e-5)
    nearest(normals, np.array([1.0, 2.0]), np.array([0.5, 1.0]), 2, np.array([0.0, 1.0, 0.0]), 5.0, found)
    assert found[0] == pytest.approx(0.0, abs=1e-5)  # the first gives way by 1, the second by 2


@pytest.mark.parametrize("distance", [0.01, 0.5, 3.0, 30.0])
def test_the_speed_of_approach_brakes_within_the_distance(distance):
    speed = approach_speed(distance, 0.7, 2.0)
    assert speed * 0.7 + speed**2 / (2.0 * 2.0) == pytest.approx(distance)


def test_a_velocity_is_the_same_object_bit_for_bit_when_nothing_is_near():
    wanted = np.array([0.1, -2.7, 1.0 / 3.0])
    others = np.array([[15.0, 0.0, 0.0], [np.nan] * 3])
    verdict = VelocityFilter(SafetySettings(), 1.0 / RATE).check(wanted, np.zeros(3), others, np.zeros((2, 3)))
    assert not verdict.corrected
    assert verdict.velocity.tobytes() == wanted.tobytes()


NO_POINTS = np.empty((0, 3))


def fly(places, goals, settings, seconds, obstacles=NO_POINTS):
    """Fly vehicles to goals; return positions (turns, N, 3) in m, until all have arrived or time is up."""
    places, velocities = places.copy(), np.zeros_like(places)
    filters = [VelocityFilter(settings, 1.0 / RATE) for _ in places]
    waiting = [np.zeros_like(places)] * DELAY
    track = [places.copy()]
    for _ in range(int(seconds * RATE)):
        commands = np.empty_like(places)
        for i, safety in enumerate(filters):
            wanted = goals[i] - places[i]
            wanted *= min(1.0, SPEED / max(np.linalg.norm(wanted), 1e-9))
            rest = np.arange(len(places)) != i
            commands[i] = safety.check(wanted, places[i], places[rest], velocities[rest], obstacles).velocity
        change = (waiting.pop(0) - velocities) / TIME_CONSTANT
        waiting.append(commands)
        change *= np.minimum(1.0, ACCELERATION / np.maximum(np.linalg.norm(change, axis=1, keepdims=True), 1e-9))
        velocities += change / RATE
        places += velocities / RATE
        track.append(places.copy())
        if np.all(np.linalg.norm(places - goals, axis=1) < 0.3):
            break
    return np.array(track)


def least_distance(track):
    return min(np.linalg.norm(track[:, i] - track[:, j], axis=1).min()
               for i, j in itertools.combinations(range(track.shape[1]), 2))  # fmt: skip


def ring(count, radius, spread=0.0, seed=0):
    angles = 2.0 * math.pi * np.arange(count) / count
    places = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(count, 10.0)], axis=1)
    return places + np.random.default_rng(seed).normal(0.0, spread, places.shape) if spread else places


@pytest.mark.parametrize(("count", "radius"), [(2, 8.0), (10, 10.0), (30, 22.0)])
@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_vehicles_exchange_places_over_the_middle(count, radius, spread):
    settings = SafetySettings()
    places = ring(count, radius, spread)
    goals = places * [-1.0, -1.0, 1.0]
    track = fly(places, goals, settings, 120.0)
    assert np.linalg.norm(track[-1] - goals, axis=1).max() < 0.3
    assert least_distance(track) > settings.distance


@pytest.mark.parametrize("seed", range(5))
def test_vehicles_change_to_random_places_in_space(seed):
    generator = np.random.default_rng(seed)
    lattice = np.array(list(itertools.product(range(3), range(3), range(2)))) * 3.0 + [0.0, 0.0, 5.0]
    places = lattice[:12] + generator.uniform(-0.5, 0.5, (12, 3))
    track = fly(places, places[generator.permutation(12)], SafetySettings(), 120.0)
    assert least_distance(track) > SafetySettings().distance


def test_straight_towards_each_other_both_give_way_to_their_right():
    track = fly(np.array([[-8.0, 0.0, 5.0], [8.0, 0.0, 5.0]]), np.array([[8.0, 0.0, 5.0], [-8.0, 0.0, 5.0]]),
                SafetySettings(), 30.0)  # fmt: skip
    assert track[:, 0, 1].min() < -0.5
    assert track[:, 1, 1].max() > 0.5
    assert track[:, :, 2] == pytest.approx(5.0)


def test_a_follower_keeps_its_velocity_behind_one_that_flies_on():
    wanted = np.array([3.0, 0.0, 0.0])
    safety = VelocityFilter(SafetySettings(), 1.0 / RATE)
    verdict = safety.check(wanted, np.zeros(3), np.array([[2.0, 0.0, 0.0]]), wanted[None])
    assert not verdict.corrected


def test_a_vehicle_retreats_from_one_that_does_not_brake():
    safety = VelocityFilter(SafetySettings(), 1.0 / RATE)
    verdict = safety.check(np.zeros(3), np.zeros(3), np.array([[3.0, 0.0, 0.0]]), np.array([[-4.0, 0.0, 0.0]]))
    assert verdict.corrected
    assert verdict.cause == 0
    assert verdict.velocity[0] < -1.0


def test_a_wall_stops_a_vehicle_at_the_distance_and_lets_it_slide():
    y, z = np.meshgrid(np.arange(-15.0, 15.0, 0.25), np.arange(0.0, 10.0, 0.25))
    wall = np.stack([np.full(y.size, 6.0), y.ravel(), z.ravel()], axis=1)
    settings = SafetySettings()
    track = fly(np.array([[0.0, 0.0, 5.0]]), np.array([[12.0, 8.0, 5.0]]), settings, 25.0, wall)
    assert 6.0 - track[:, 0, 0].max() == pytest.approx(settings.obstacle_distance, abs=0.1)
    assert track[-1, 0, 1] == pytest.approx(8.0, abs=1.0)


def test_two_at_the_same_place_part():
    safety = VelocityFilter(SafetySettings(), 1.0 / RATE)
    verdict = safety.check(np.zeros(3), np.zeros(3), np.zeros((1, 3)), np.zeros((1, 3)))
    assert verdict.velocity[2] > 0.5
    assert np.all(np.isfinite(verdict.velocity))


def test_the_nearest_point_of_a_cloud_is_always_among_those_of_the_sectors():
    generator = np.random.default_rng(3)
    points = generator.uniform(-10.0, 10.0, (5000, 3))
    points = np.vstack([points, [[np.nan, 2.0, 3.0], [np.inf, 2.0, 3.0]]])  # points in no sector
    near = np.empty((SECTORS, 3))
    position = np.array([1.0, 2.0, 3.0])
    count = nearest_by_sector(points, position, 8.0, near)
    distances = np.linalg.norm(points - position, axis=1)
    assert np.linalg.norm(near[:count] - position, axis=1).min() == np.nanmin(distances)
    assert np.all(np.linalg.norm(near[:count] - position, axis=1) < 8.0)
    assert count > SECTORS // 2


def test_points_of_a_sensor_are_placed_by_mount_and_attitude():
    half = math.sqrt(0.5)
    points = np.array([[2.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [0.1, 0.0, 0.0], [50.0, 0.0, 0.0]])
    found = place_points(points, np.array([0.5, 0.0, 0.1]), (1.0, 0.0, 0.0, 0.0), np.array([10.0, 0.0, 5.0]),
                   (half, 0.0, 0.0, half), 20.0)  # fmt: skip
    assert found == pytest.approx(np.array([[10.0, 2.5, 5.1], [10.0, 0.6, 5.1]]))  # facing north
