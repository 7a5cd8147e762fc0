"""A moving goal, as of a follower's velocity, is followed without stops, and around obstacles."""

from __future__ import annotations

import numpy as np
import pytest
from toy_flight import LIMITS, PERIOD, ToyFlight, forest

from xtdrone_planning.mapping.voxel_grid import MapSettings, VoxelGrid
from xtdrone_planning.paths.local_path import nearest_clear
from xtdrone_planning.planner_settings import GoalError

SPEED = 1.5  # m/s of the slot
CARRY = 1.15  # s; without an agreed time, less than in forest.launch


def follow(flight: ToyFlight, seconds: float, begin: float, end: float) -> list[float]:
    """Fly behind a slot that moves along x between two times; return the distances from it, m."""
    flight.planner.set_goal(np.array([0.5, 0.0, 2.0]))
    errors = []
    for _ in range(round(seconds / PERIOD)):
        moves = begin < flight.time < end
        slot = np.array([0.5 + SPEED * np.clip(flight.time - begin, 0.0, end - begin), 0.0, 2.0])
        velocity = slot - flight.position + (SPEED if moves else 0.0) * np.array([1.0, 0.0, 0.0])
        velocity *= min(1.0, 3.0 / max(float(np.linalg.norm(velocity)), 1e-9))
        if flight.time > 2.0:
            flight.planner.move_goal(flight.position + CARRY * velocity)
        flight.step()
        errors.append(float(np.linalg.norm(slot - flight.position)))
    return errors


def test_a_moving_slot_is_followed_and_reached():
    errors = follow(ToyFlight(np.zeros((0, 3))), 24.0, 4.0, 16.0)
    steady = errors[round(8.0 / PERIOD) : round(16.0 / PERIOD)]
    assert max(steady) < 0.3
    assert max(errors[-round(2.0 / PERIOD) :]) < 0.06


def test_a_slot_that_moves_through_trunks_is_followed_round_them():
    flight = ToyFlight(forest(2))
    errors = follow(flight, 34.0, 4.0, 22.0)
    assert flight.clearance() > LIMITS.radius
    assert max(errors[-round(2.0 / PERIOD) :]) < 0.06
    assert max(errors) < 4.0


def test_a_moved_goal_does_not_begin_a_flight_and_is_checked():
    flight = ToyFlight(np.zeros((0, 3)))
    flight.planner.move_goal(np.array([5.0, 0.0, 2.0]))
    flight.run(1.0)
    assert flight.planner.state.name == "waiting"
    flight.planner.set_goal(np.array([5.0, 0.0, 2.0]))
    flight.run(1.0)
    with pytest.raises(GoalError, match=r"height 0.10 is not allowed, 0.8 to 5 m"):
        flight.planner.move_goal(np.array([5.0, 0.0, 0.1]))
    flight.offboard = False  # the pilot takes over
    flight.run(0.2)
    flight.planner.move_goal(np.array([9.0, 0.0, 0.1]))  # as of a leader that lands: ignored, not refused
    flight.run(1.0)
    assert flight.planner.goal is None
    assert flight.planner.state.name == "waiting"


def test_the_nearest_clear_place_is_clear_and_no_nearer_one_is():
    grid = VoxelGrid(MapSettings(side=8.0, height=1.6))
    rng = np.random.default_rng(3)
    grid.evidence[rng.random(grid.evidence.shape) < 0.004] = 300
    grid.update_distance()
    for place in rng.uniform((-2.0, -2.0, -0.7), (2.0, 2.0, 0.7), (40, 3)):
        found = nearest_clear(grid, place, 0.5)
        layer = grid.index(place)[2]
        clear = np.argwhere(grid.distance[:, :, layer] >= 0.5)
        middles = grid.middle(np.column_stack([clear, np.full(len(clear), layer)]))
        best = np.hypot(*(middles - place)[:, :2].T).min()
        assert found[2] == place[2]
        if grid.distance[grid.index(place)] >= 0.5 or best > 2.0:
            assert np.array_equal(found, place)
        else:
            assert grid.distance[grid.index(found)] >= 0.5
            assert np.hypot(*(found - place)[:2]) == pytest.approx(best)
