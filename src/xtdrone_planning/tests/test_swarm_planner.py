"""Several planners that coordinate by radio, without a simulator: separation, precedence, delays and losses."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from toy_flight import LIMITS, PERIOD, ToyFlight, forest, wall
from toy_swarm import Group

from xtdrone_control.network.network_options import NetworkOptions
from xtdrone_planning.paths.local_path import PathQuery, PathSearch
from xtdrone_planning.planner_settings import AgreementSettings
from xtdrone_planning.replanning.swarm_planner import FORGET, Known, Proposal, SwarmPlanner
from xtdrone_planning.trajectories.moving_vehicles import MovingVehicles
from xtdrone_planning.trajectories.splines.spline_cost import UPRIGHT
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline, coasting, resting

RADIUS = LIMITS.radius


@pytest.mark.parametrize(("delay", "loss", "check"), [(0.0, 0.0, 0.2), (0.3, 0.1, 0.8)])
def test_vehicles_exchange_sides_and_keep_their_distance(delay, loss, check):
    group = Group(4, NetworkOptions(delay=delay, loss=loss), AgreementSettings(check=check), seed=2)
    assert group.run(40.0) < 40.0
    assert group.least > 2.0 * RADIUS + AgreementSettings().separation - 0.1
    for states in group.states:
        assert states[-2:] == ["following", "hovering at the goal"]
        assert len(states) < 12  # no change with each turn while a proposal is open


def test_without_hearing_each_other_they_would_meet():
    group = Group(2, NetworkOptions(loss=1.0), AgreementSettings(check=0.2))
    group.run(40.0)
    assert group.least < 2.0 * RADIUS


class RestlessGroup(Group):
    """Vehicles whose goals change like those of explorers, often while a proposal is undecided."""

    def after_turn(self, now: float) -> None:
        """Change a goal now and then."""
        rng = np.random.default_rng(round(now / PERIOD))
        for flight in self.flights:
            if now > 1.0 and rng.random() < 0.04:
                flight.planner.set_goal(np.array([*rng.uniform((0.0, -3.0), (8.0, 3.0)), 2.0]))


def test_vehicles_whose_goals_change_fly_on_from_where_they_are():
    group = RestlessGroup(3, NetworkOptions(), AgreementSettings(check=0.2), seed=1)
    group.run(25.0)
    for flight in group.flights:
        assert np.linalg.norm(np.diff(flight.track, axis=0), axis=1).max() < LIMITS.speed * PERIOD * 1.01
        changes = list(itertools.pairwise(flight.states))
        assert changes.count(("following", "planning")) < 60  # not in every turn of a pause
    assert group.least > 2.0 * RADIUS


def line(start, end, begin, duration=4.0):
    points = np.linspace(start, end, 11)
    return UniformSpline(begin, duration / 10.0, np.vstack([points[:1], points[:1], points, points[-1:], points[-1:]]))


def test_the_time_of_an_approach_is_that_of_a_fine_search():
    own = line((0.0, 0.0, 2.0), (10.0, 0.0, 2.0), 5.0)
    for begin in (3.0, 5.0, 6.0, 9.0):
        other = line((5.0, -5.0, 2.0), (5.0, 5.0, 2.0), begin)
        times = np.arange(5.0, 16.0, 0.005)
        near = np.linalg.norm(own.positions(times) - other.positions(times), axis=1) < 1.5
        expected = times[near][0] if near.any() else math.inf
        found = MovingVehicles([other], [1.5]).conflict_time(own, 5.0)
        assert found == pytest.approx(expected, abs=0.1)


def test_who_is_too_near_at_first_may_part_and_not_come_nearer():
    other = MovingVehicles([resting(np.array([0.0, 1.0, 2.0]), 0.0)], [1.5])
    assert other.conflict_time(line((0.0, 0.0, 2.0), (0.0, -5.0, 2.0), 0.0), 0.0) == math.inf
    assert other.conflict_time(line((0.0, 0.0, 2.0), (0.0, 5.0, 2.0), 0.0), 0.0) < 2.0


def proposal(number, made, rank, start=10.0):
    return Proposal(number, resting(np.zeros(3), start), made, rank)


def test_the_earlier_proposal_counts_then_the_lower_rank():
    assert proposal(1, 2.0, 5).precedes(proposal(9, 2.1, 0))
    assert proposal(1, 2.0, 0).precedes(proposal(9, 2.0, 1))
    assert not proposal(1, 2.0, 1).precedes(proposal(1, 2.0, 1))


def test_what_was_overtaken_on_its_way_is_ignored():
    known = Known()
    for number, made in ((3, 8.0), (4, 8.5), (5, 9.0)):
        known.on_proposal(proposal(number, made, 0), RADIUS)
    known.on_decided(4, resting(np.ones(3), 8.9), RADIUS)
    known.on_decided(2, resting(np.zeros(3), 7.9), RADIUS)
    known.on_proposal(proposal(3, 8.0, 0), RADIUS)
    assert known.number == 4
    assert list(known.proposals) == [5]
    assert len(known.trajectories()) == 2
    known.forget(10.0 + FORGET + 0.01)
    assert known.trajectories()[0].points[0, 0] == 1.0
    assert len(known.trajectories()) == 1


def test_a_planner_that_was_restarted_counts_from_1_and_is_heard():
    known = Known()
    known.on_proposal(proposal(38, 20.5, 0, start=20.9), RADIUS)
    known.on_decided(37, resting(np.zeros(3), 20.0), RADIUS)
    known.on_decided(1, resting(np.ones(3), 24.0), RADIUS)
    assert (known.number, known.decided.points[0, 0], known.proposals) == (1, 1.0, {})
    known.on_proposal(proposal(2, 24.3, 0, start=24.7), RADIUS)
    known.on_decided(37, resting(np.zeros(3), 20.0), RADIUS)  # delayed
    assert known.number == 1
    known.on_decided(2, resting(np.full(3, 2.0), 24.7), RADIUS)
    assert (known.number, known.proposals) == (2, {})


def test_a_proposal_of_a_restarted_planner_counts_though_its_trajectory_was_lost():
    known = Known()
    known.on_decided(37, resting(np.zeros(3), 20.0), RADIUS)
    known.on_proposal(proposal(2, 24.3, 0, start=24.7), RADIUS)
    assert list(known.proposals) == [2]
    known.on_decided(1, resting(np.ones(3), 24.0), RADIUS)  # a repetition arrives
    assert list(known.proposals) == [2]


def test_the_radius_of_a_vehicle_is_that_of_its_last_message():
    flight = ToyFlight(np.zeros((0, 3)))
    planner = SwarmPlanner(flight.map.grid, flight.settings, flight.limits, AgreementSettings(), rank=1)
    reaches = []
    for number, radius in ((1, RADIUS), (2, 2.0 * RADIUS)):
        planner.on_decided(0, number, resting(np.zeros(3), float(number)), radius)
        reaches.append(planner.places_of_others(3.0)[1][0])
    planner.on_decided(0, 1, resting(np.zeros(3), 1.0), RADIUS)  # delayed
    reaches.append(planner.places_of_others(3.0)[1][0])
    assert reaches[1] - reaches[0] == pytest.approx(RADIUS)
    assert reaches[2] == reaches[1]


def test_a_vehicle_finds_its_way_round_one_that_waits_among_trunks():
    flight = ToyFlight(forest(2), position=np.array([28.0, -4.0, 2.0]))
    flight.planner = SwarmPlanner(flight.map.grid, flight.settings, flight.limits, AgreementSettings(check=0.2), rank=1)
    waiting = np.array([25.3, -3.7, 2.1])
    flight.planner.on_decided(0, 1, resting(waiting, 0.0), RADIUS)
    flight.planner.set_goal(np.array([18.0, -4.0, 2.0]))
    flight.run(30.0, "hovering at the goal")
    assert flight.planner.state.name == "hovering at the goal"
    assert np.linalg.norm(np.array(flight.track) - waiting, axis=1).min() > 2.0 * RADIUS + 0.3
    assert flight.clearance() > RADIUS


def test_a_path_leads_round_the_place_where_another_rests():
    flight = ToyFlight(wall(8.0, -12.0, -2.0))
    flight.run(1.0)
    others = MovingVehicles([resting(np.array([6.0, 0.0, 2.0]), 0.0)], [1.5])
    clearance = LIMITS.clearance(flight.map.grid.resolution)
    distance = others.near_rest(flight.map.grid, clearance)
    grid = flight.map.grid
    for place in itertools.product(np.arange(3.0, 9.0, 0.35), np.arange(-3.0, 3.0, 0.35), (1.5, 2.0, 2.5)):
        voxel = grid.index(np.array(place))
        off = np.linalg.norm((grid.middle(np.array(voxel)) - (6.0, 0.0, 2.0)) * (1.0, 1.0, UPRIGHT))
        if off < 1.5:
            assert 0.0 < distance[voxel] < clearance
        assert distance[voxel] <= grid.distance[voxel]
    query = PathQuery(flight.position, np.array([12.0, 0.0, 2.0]), clearance, LIMITS.radius, (0.8, 5.0), 20.0)
    path = PathSearch(25000).find(grid, query, distance)
    along = np.vstack([np.linspace(a, b, 20) for a, b in itertools.pairwise(path.points)])
    assert np.linalg.norm(along - (6.0, 0.0, 2.0), axis=1).min() > 1.4


def blown_off(flight: ToyFlight) -> None:
    """Fly at speed, then displace the vehicle by 1.5 m from the trajectory."""
    flight.planner = SwarmPlanner(flight.map.grid, flight.settings, flight.limits, AgreementSettings(check=0.2), rank=1)
    flight.planner.set_goal(np.array([16.0, 0.0, 2.0]))
    flight.run(3.5)
    assert flight.velocity[0] > 2.0
    flight.position = flight.position + np.array([0.0, 1.5, 0.0])


def test_a_vehicle_that_was_led_off_its_trajectory_flies_on_from_there():
    flight = ToyFlight(np.zeros((0, 3)))
    blown_off(flight)
    begin = len(flight.track)
    flight.run(12.0, "hovering at the goal")
    assert flight.planner.state.name == "hovering at the goal"
    assert flight.states == ["planning", "following", "hovering at the goal"]
    steps = np.linalg.norm(np.diff(flight.track[begin:], axis=0), axis=1)
    assert steps.max() < LIMITS.speed * PERIOD * 1.01  # no jump back
    assert min(command.velocity[0] for command in flight.commands[begin : begin + 20]) > 1.0


def test_without_a_way_on_it_stops_where_it_has_come_to():
    flight = ToyFlight(np.zeros((0, 3)))
    blown_off(flight)
    flight.planner.plan = lambda *_: False
    place, velocity = flight.position, flight.velocity
    flight.run(4.0)
    way = flight.position - place
    assert way[0] == pytest.approx(velocity[0] ** 2 / (2.0 * 0.8 * LIMITS.acceleration), rel=0.25)
    assert way[1:] == pytest.approx([0.0, 0.0], abs=0.1)
    assert flight.velocity == pytest.approx(np.zeros(3), abs=1e-6)


def test_rays_that_end_at_other_vehicles_are_not_entered():
    other = np.array([5.0, 0.0, 2.0])
    flights = [ToyFlight(np.array([[5.0, 0.0, 0.35], [5.0, 4.0, 0.35]])) for _ in range(2)]
    flights[1].map.others = lambda _: (other[None], np.array([0.7]))
    for flight, known in zip(flights, (False, True), strict=True):
        flight.run(1.0)
        occupied = flight.map.grid.occupied()
        at_other = np.linalg.norm(occupied - other, axis=1) < 0.5
        assert at_other.any() != known
        assert (np.linalg.norm(occupied - (5.0, 4.0, 2.0), axis=1) < 0.5).any()


def test_places_of_others_are_those_on_their_trajectories():
    flight = ToyFlight(np.zeros((0, 3)))
    planner = SwarmPlanner(flight.map.grid, flight.settings, flight.limits, AgreementSettings(), rank=1)
    planner.on_decided(0, 1, coasting(np.zeros(3), np.array([2.0, 0.0, 0.0]), 10.0), RADIUS)
    for time in (9.8, 10.0, 11.0):  # before its start it is on the previous one, of which this one is the continuation
        places, reach = planner.places_of_others(time)
        assert places == pytest.approx(np.array([[2.0 * (time - 10.0), 0.0, 0.0]]), abs=1e-9)
        assert RADIUS < reach[0] < 2.0 * RADIUS
