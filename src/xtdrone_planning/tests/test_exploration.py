"""Exploration without ROS: maps of floors and their merging, routes, sharing by messages, whole flights on floors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from toy_floor import ToyFloor, rooms

from xtdrone_common.settings import SettingError
from xtdrone_planning.exploration.choice_of_frontier import AT_GOAL, HOME, Explorer
from xtdrone_planning.exploration.floor_map import FLOWN, FREE, OCCUPIED, UNKNOWN, FloorMap
from xtdrone_planning.exploration.frontiers import Ways, find_frontiers
from xtdrone_planning.exploration.settings import ExplorationSettings
from xtdrone_planning.exploration.shared_regions import PROPOSAL, STATE, Share, Sharing
from xtdrone_planning.exploration.tours import divide, route_length

SMALL = ExplorationSettings(bounds=(0.0, 0.0, 10.0, 6.0), margin=0.0, cell=0.2)


def known_floor() -> FloorMap:
    """Return a floor of 10 x 6 m with a wall at x = 5 m that leaves a gap from y = 4 m on; x > 8 m is unknown."""
    floor = FloorMap(SMALL)
    floor.own[:40] = FREE
    floor.own[25, :20] = OCCUPIED
    floor.merge()
    return floor


def test_ways_lead_through_the_gap_with_clearance() -> None:
    floor = known_floor()
    ways = Ways(floor, floor.index(np.array([1.0, 1.0])), 0.5)
    route = np.array(ways.route(floor.index(np.array([7.0, 1.0]))))
    assert floor.distance[route[:, 0], route[:, 1]].min() >= 0.5
    around = math.hypot(4.1, 3.3) + math.hypot(1.9, 3.3)  # two straight parts, past the wall's end at (5.1, 4.3)
    assert around <= float(ways.costs[tuple(route[-1])]) < 1.6 * around  # cells near walls cost more
    assert not np.isfinite(Ways(floor, floor.index(np.array([1.0, 1.0])), 2.3).costs[tuple(route[-1])])


def test_frontiers_are_where_free_space_meets_the_unknown() -> None:
    floor = known_floor()
    ways = Ways(floor, floor.index(np.array([1.0, 1.0])), 0.5)
    found = find_frontiers(floor, ways, np.zeros(floor.own.shape, np.bool_), 4)
    assert found
    assert {int(cell[0]) for frontier in found for cell in frontier.cells} == {39}
    assert all(frontier.view is not None for frontier in found)
    floor.own[25] = OCCUPIED  # the gap is closed
    floor.merge()
    cut_off = find_frontiers(floor, Ways(floor, (5, 5), 0.5), np.zeros(floor.own.shape, np.bool_), 4)
    assert cut_off
    assert all(frontier.view is None for frontier in cut_off)


def test_a_map_in_another_frame_is_merged_by_the_relative_pose() -> None:
    floor, seen = FloorMap(SMALL), np.full((20, 10), FREE, np.int8)
    seen[15, 5] = OCCUPIED  # at x 3.1, y 1.1 m of the other's frame
    floor.hear("other", np.array([6.0, 1.0]), math.pi / 2, seen)  # its x axis points north
    floor.merge()
    i, j = floor.index(np.array([6.0 - 1.1, 1.0 + 3.1]))
    assert floor.values[i, j] == OCCUPIED
    assert np.count_nonzero(floor.values == OCCUPIED) == 1
    assert np.count_nonzero(floor.values == FREE) == 199
    assert (floor.own == UNKNOWN).all()


def test_where_a_vehicle_has_flown_is_free_for_all() -> None:
    floor, other = FloorMap(SMALL), FloorMap(SMALL)
    floor.own[10:20, 10:20] = OCCUPIED  # another vehicle that passed by
    other.fly_through(np.array([3.0, 3.0]), 0.4)
    floor.hear("other", np.zeros(2), 0.0, other.own)
    floor.merge()
    assert floor.values[floor.index(np.array([3.0, 3.0]))] == FLOWN
    assert floor.values[10, 10] == OCCUPIED


def test_slices_replace_what_was_known_but_not_where_the_vehicle_was() -> None:
    floor = known_floor()
    floor.fly_through(np.array([1.0, 1.0]), 0.3)
    floor.enter(np.array([-0.4, 0.0]), np.full((60, 60), OCCUPIED, np.int8))  # reaches beyond the floor
    assert floor.own[floor.index(np.array([1.0, 1.0]))] == FLOWN
    assert floor.own[floor.index(np.array([9.0, 5.0]))] == OCCUPIED


def test_a_floor_that_would_fill_memory_is_refused() -> None:
    with pytest.raises(SettingError, match="at most 4000000 cells"):
        ExplorationSettings(bounds=(0.0, 0.0, 5000.0, 5000.0))


def test_two_routes_share_the_places() -> None:
    rng = np.random.default_rng(3)
    places = np.vstack([[[0.0, 0.0], [10.0, 0.0]], rng.uniform(0.0, 10.0, (12, 2))])
    ways = np.sqrt(((places[:, None] - places) ** 2).sum(axis=2))
    routes = divide(ways, 2)
    assert sorted(routes[0] + routes[1]) == list(range(14))
    alone = route_length(ways, divide(np.delete(np.delete(ways, 1, 0), 1, 1), 1)[0])
    assert max(route_length(ways, route) for route in routes) < 0.75 * alone


def halves(place: tuple[float, float], mine: frozenset[int], theirs: frozenset[int]):
    """Divide regions by number: the vehicle that proposes gets the lower half."""
    order = sorted(mine | theirs)
    return frozenset(order[: len(order) // 2]), frozenset(order[len(order) // 2 :])


def exchange(loss: float, seconds: float, silent_after: float = math.inf) -> list[Sharing]:
    """Run three vehicles that share eight regions by messages, which are lost with a probability."""
    names = ["a", "b", "c"]
    vehicles = [Sharing(name, names, 8, 5.0) for name in names]
    rng = np.random.default_rng(1)
    for tick in range(int(seconds / 0.25)):
        now = 0.25 * tick
        for n, vehicle in enumerate(vehicles if now < silent_after else vehicles[:2]):
            for message in vehicle.step(now, (0.0, 0.0), (0.0, 0.0), frozenset(range(8)), halves):
                for m, other in enumerate(vehicles):
                    if m != n and rng.uniform() >= loss:
                        other.hear(message, now)
    return vehicles


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_every_region_has_an_owner_in_the_end(loss: float) -> None:
    a, b, c = exchange(loss, 60.0)
    assert a.own | b.own | c.own == frozenset(range(8))
    assert all(vehicle.own for vehicle in (a, b, c))
    if not loss:
        assert sum(len(vehicle.own) for vehicle in (a, b, c)) == 8


def test_the_regions_of_a_lost_vehicle_are_taken_over() -> None:
    a, b, c = exchange(0.0, 60.0, silent_after=20.0)
    assert c.own
    assert a.own | b.own == frozenset(range(8))
    assert a.lost() == b.lost() == ["c"]


def test_a_proposal_for_regions_that_have_changed_is_refused() -> None:
    vehicle = Sharing("b", ["a", "b"], 4, 5.0)
    wrong = Share("a", PROPOSAL, 1, "b", base=7, regions=frozenset({0}), partner_regions=frozenset({1, 2, 3}))
    vehicle.hear(Share("a", STATE, 0, regions=frozenset(range(4))), 0.0)
    vehicle.hear(wrong, 0.0)
    vehicle.hear(Share("stranger", STATE, 0), 0.0)
    answers = vehicle.step(0.0, (0.0, 0.0), (0.0, 0.0), frozenset(range(4)), lambda _, mine, theirs: (mine, theirs))
    assert [(m.kind, m.number, m.partner) for m in answers if m.kind != STATE] == [(3, 1, "a")]
    assert vehicle.own == frozenset()


SEEDS = (0, 1, 2)


def test_floors_are_explored_and_two_vehicles_are_faster() -> None:
    one, two = [], []
    for seed in SEEDS:
        for starts, times in (([(1.3, 10.0)], one), ([(1.3, 9.0), (1.3, 11.0)], two)):
            flight = ToyFloor(rooms(seed), starts)
            flight.fly()
            assert flight.coverage() >= 0.95
            assert all(explorer.state == HOME for explorer in flight.explorers)
            times.append(next(time for time, share in flight.curve if share >= 0.95))
    assert sum(two) <= 0.65 * sum(one), (one, two)


@pytest.mark.parametrize("bearing", np.linspace(0.0, 2.0 * math.pi, 8, endpoint=False))
def test_a_frontier_that_stays_is_given_up_though_the_planner_ends_beside_the_view(bearing: float) -> None:
    aside = 0.28 * np.array([math.cos(bearing), math.sin(bearing)])  # m; less than the distance that makes a new goal
    explorer = Explorer(SMALL, "uav_0", ["uav_0"])
    explorer.floor.own[:40] = FREE  # after that, no new cell is ever seen
    explorer.floor.own[:, 0] = explorer.floor.own[:, -1] = OCCUPIED
    explorer.start(np.array([1.0, 3.0]))
    position, planner, still = np.array([1.0, 3.0]), "waiting", 0
    for turn in range(200):
        decision = explorer.step(0.5 * turn, position, planner)
        if decision.goal is not None:
            position, planner, still = decision.goal + aside, AT_GOAL, 0
        still += 1
        if explorer.state in ("returning", HOME):
            return
        assert still < 8, "it hovers"
    pytest.fail("it does not end")


def test_a_vehicle_that_is_lost_does_not_keep_the_other_from_exploring_everything() -> None:
    flight = ToyFloor(rooms(2, 24.0, 18.0), [(1.3, 8.0), (1.3, 10.0)], (0.0, 0.0, 24.0, 18.0), loss=0.2, dies=8.0)
    flight.fly()
    assert flight.explorers[0].state == HOME
    assert flight.coverage() >= 0.95
    assert flight.explorers[0].sharing.lost() == ["uav_1"]
