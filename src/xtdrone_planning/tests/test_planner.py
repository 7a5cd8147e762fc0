"""The planner flies through observed space, and reports goals that it cannot reach."""

from __future__ import annotations

import math

import numpy as np
import pytest
from toy_flight import LIMITS, ToyFlight, forest, wall

from xtdrone_planning.planner_settings import GoalError, PlannerSettings

GOAL = np.array([28.0, 0.0, 2.0])
ARRIVED = "hovering at the goal"


@pytest.mark.parametrize("seed", range(4))
def test_it_flies_through_a_forest_without_a_touch_and_within_its_limits(seed):
    uncompensated = PlannerSettings(lead=0.0, attitude_lag=0.0, drag=0.0, damping=0.0)
    flight = ToyFlight(forest(seed), settings=uncompensated)
    flight.planner.set_goal(GOAL)
    flight.run(40.0, ARRIVED)
    assert flight.planner.state.name == ARRIVED
    assert np.allclose(flight.position, GOAL, atol=0.01)
    assert flight.clearance() > LIMITS.radius
    speeds = [np.linalg.norm(command.velocity) for command in flight.commands]
    accelerations = [np.linalg.norm(command.acceleration) for command in flight.commands]
    assert max(speeds) <= LIMITS.speed + 1e-3
    assert max(accelerations) <= LIMITS.acceleration + 1e-3
    assert max(speeds) > 0.8 * LIMITS.speed


@pytest.mark.parametrize("seed", range(4))
def test_it_keeps_within_its_heights(seed):
    settings = PlannerSettings(lead=0.0, lowest=1.9, highest=2.1)
    flight = ToyFlight(forest(seed), settings=settings)
    flight.position = np.array([0.0, 0.0, 1.95])
    for goal in (np.array([28.0, 0.0, 2.1]), np.array([0.0, 0.0, 1.9])):
        flight.planner.set_goal(goal)
        flight.run(30.0, ARRIVED)
        assert flight.planner.state.name == ARRIVED
    heights = [command.position[2] for command in flight.commands]
    assert min(heights) >= settings.lowest - 0.02
    assert max(heights) <= settings.highest + 0.02


def test_setpoints_are_continuous_over_new_plans():
    flight = ToyFlight(forest(5))
    flight.planner.set_goal(GOAL)
    flight.run(40.0, ARRIVED)
    assert flight.planner.number > 10
    velocities = np.array([command.velocity for command in flight.commands])
    positions = np.array([command.position for command in flight.commands])
    assert np.linalg.norm(np.diff(velocities, axis=0), axis=1).max() < 0.05 * LIMITS.acceleration + 0.02
    assert np.linalg.norm(np.diff(positions, axis=0), axis=1).max() < 0.05 * LIMITS.speed + 0.02


def test_it_looks_where_it_flies():
    flight = ToyFlight(np.zeros((0, 3)))
    flight.planner.set_goal(np.array([0.0, 9.0, 2.0]))
    flight.run(20.0, ARRIVED)
    assert flight.commands[-1].yaw == pytest.approx(math.pi / 2, abs=0.1)
    yaws = np.unwrap([command.yaw for command in flight.commands])
    assert np.abs(np.diff(yaws)).max() <= 1.5 * 0.05 + 1e-9


def test_a_goal_in_a_wall_is_unreachable_and_another_goal_is_flown():
    flight = ToyFlight(wall(8.0, -4.0, 4.0))
    flight.planner.set_goal(np.array([8.0, 0.0, 2.0]))
    flight.run(30.0, "goal unreachable")
    assert flight.planner.state.name == "goal unreachable"
    assert "m from an obstacle" in flight.planner.searched
    assert flight.clearance() > LIMITS.radius
    flight.planner.set_goal(np.array([0.0, 3.0, 2.0]))
    flight.run(20.0, ARRIVED)
    assert flight.planner.state.name == ARRIVED


def test_a_goal_in_a_closed_room_is_unreachable():
    room = [wall(x, -4.0, 4.0) for x in (-4.0, 4.0)] + [wall(y, -4.0, 4.0)[:, [1, 0, 2]] for y in (-4.0, 4.0)]
    flight = ToyFlight(np.vstack(room), settings=PlannerSettings(lead=0.0, highest=3.0))
    flight.planner.set_goal(np.array([7.0, 0.0, 2.0]))
    flight.run(20.0, "goal unreachable")
    assert flight.planner.state.name == "goal unreachable"
    assert "no path" in flight.planner.searched
    assert flight.clearance() > LIMITS.radius


def test_it_finds_the_way_round_a_long_wall():
    flight = ToyFlight(wall(6.0, -6.0, 5.0))
    flight.planner.set_goal(np.array([12.0, 0.0, 2.0]))
    flight.run(40.0, ARRIVED)
    assert flight.planner.state.name == ARRIVED
    assert flight.clearance() > LIMITS.radius


def test_a_silent_sensor_makes_it_brake_on_its_path_and_hover_until_the_sensor_is_back():
    flight = ToyFlight(forest(1))
    flight.planner.set_goal(GOAL)
    flight.run(4.0)
    assert flight.planner.state.name == "following"
    path = flight.planner.trajectory.positions(np.linspace(flight.time, flight.planner.trajectory.end, 2000))
    flight.silent, flight.fault, begun = True, "sensor silent for 0.6 s", len(flight.track)
    flight.step()
    assert flight.planner.state.name == "braking"
    assert flight.planner.state.report(flight.planner, _situation(flight))[0] == 2
    flight.run(5.0)
    assert np.allclose(flight.velocity, 0.0)
    for place in flight.track[begun:]:
        assert np.linalg.norm(path - place, axis=1).min() < 0.05
    flight.silent, flight.fault = False, ""
    flight.run(30.0, ARRIVED)
    assert flight.planner.state.name == ARRIVED


def _situation(flight: ToyFlight):
    from xtdrone_planning.replanning.flight_states import Situation

    return Situation(flight.time, flight.position, flight.velocity, 0.0, True, True, flight.scans, flight.fault)


def test_an_obstacle_that_appears_on_the_trajectory_is_not_hit():
    flight = ToyFlight(np.array([(30.0, 30.0, 0.3)]))
    flight.planner.set_goal(GOAL)
    flight.run(4.0)
    ahead = flight.position[0] + 6.0
    flight.trunks = np.array([(ahead, y, 0.3) for y in np.arange(-3.0, 3.1, 0.4)])
    begun = len(flight.track)
    flight.run(40.0, ARRIVED)
    flight.track = flight.track[begun:]
    assert flight.planner.state.name == ARRIVED
    assert flight.clearance() > LIMITS.radius


def test_when_nothing_else_is_left_it_brakes():
    flight = ToyFlight(np.array([(30.0, 30.0, 0.3)]))
    flight.planner.set_goal(GOAL)
    flight.run(4.0)
    place = flight.position
    ahead = place[0] + 5.0
    flight.trunks = np.vstack(
        [wall(ahead, -3.0, 3.0), [(x, y, 0.3) for x in np.arange(place[0] - 3.0, ahead, 0.4) for y in (-3.0, 3.0)]]
    )
    flight.run(6.0)
    assert "braking" in flight.states or "planning" in flight.states
    assert np.linalg.norm(flight.velocity) < 4.0
    flight.track = flight.track[-20:]
    assert flight.clearance() > LIMITS.radius


def test_a_new_goal_in_flight_is_flown_without_a_stop():
    flight = ToyFlight(np.zeros((0, 3)))
    flight.planner.set_goal(GOAL)
    flight.run(4.0)
    flight.planner.set_goal(np.array([28.0, 10.0, 2.0]))
    flight.run(30.0, ARRIVED)
    assert flight.states == ["planning", "following", ARRIVED]
    assert np.allclose(flight.position, (28.0, 10.0, 2.0), atol=0.01)


def test_without_offboard_it_only_streams_its_position_and_when_the_pilot_takes_over_it_lets_go():
    flight = ToyFlight(np.zeros((0, 3)))
    flight.offboard = False
    flight.planner.set_goal(GOAL)
    flight.run(3.0)
    assert flight.states == ["planning"]
    assert np.allclose(flight.position, (0.0, 0.0, 2.0))
    flight.offboard = True
    flight.run(2.0)
    assert flight.planner.state.name == "following"
    flight.offboard = False
    flight.step()
    assert flight.planner.state.name == "waiting"
    assert flight.planner.goal is None
    count = len(flight.commands)
    flight.run(1.0)
    assert len(flight.commands) == count


def test_a_goal_on_the_ground_is_dropped():
    flight = ToyFlight(np.zeros((0, 3)))
    flight.flying = flight.offboard = False
    flight.planner.set_goal(GOAL)
    flight.run(0.2)
    assert flight.planner.goal is None
    level, text = flight.planner.state.report(flight.planner, _situation(flight))
    assert (level, text) == (1, "waiting; a goal was dropped: the vehicle is not flying")


def test_a_dropped_goal_ends_the_flight_with_a_stop():
    flight = ToyFlight(np.zeros((0, 3)))
    flight.planner.set_goal(GOAL)
    flight.run(4.0)
    flight.planner.cancel()
    flight.run(4.0)
    assert flight.states == ["planning", "following", "braking", "hovering"]
    assert np.allclose(flight.velocity, 0.0)


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        ((math.nan, 0.0, 2.0), "finite"),
        ((2e5, 0.0, 2.0), "finite numbers within"),
        ((0.0, 0.0, 0.2), "height 0.20 is not allowed, 0.8 to 5 m"),
        ((0.0, 0.0, 9.0), "height 9.00"),
    ],
)
def test_goals_that_are_not_allowed_leave_the_flight_as_it_is(goal, words):
    flight = ToyFlight(np.zeros((0, 3)))
    flight.planner.set_goal(GOAL)
    flight.run(3.0)
    with pytest.raises(GoalError, match=words):
        flight.planner.set_goal(np.array(goal))
    flight.run(20.0, ARRIVED)
    assert np.allclose(flight.position, GOAL, atol=0.01)
