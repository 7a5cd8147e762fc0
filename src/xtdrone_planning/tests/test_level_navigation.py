"""Navigation on a level: rays of scans, costs, paths, the dynamic window, states, and goals of the action server."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import rospy
from actionlib_msgs.msg import GoalID
from move_base_msgs.msg import MoveBaseActionGoal

from xtdrone_common.settings import SettingError
from xtdrone_planning.navigation import action_server
from xtdrone_planning.navigation.action_server import ActionGoals
from xtdrone_planning.navigation.dynamic_window import AT_REST, Motion, choose, move_along_arc, window
from xtdrone_planning.navigation.global_path import GlobalSearch, PathError
from xtdrone_planning.navigation.level_map import INSCRIBED, LETHAL, UNKNOWN, LevelMap, MapError, ScanRays
from xtdrone_planning.navigation.navigator import ABORTED, SUCCEEDED, WAITING, Navigator, Turn
from xtdrone_planning.navigation.settings import (
    CostmapSettings,
    NavigationGoalError,
    NavigatorSettings,
    WindowSettings,
    check_reach,
)

CELL, SIDE, TURN = 0.1, 200, 0.05
LIMITS = WindowSettings()


def a_map(*walls: tuple[int, int, int, int]) -> LevelMap:
    """Return a free map of 20 x 20 m with walls (first and last x, first and last y, cells)."""
    values = np.zeros((SIDE, SIDE), np.int8)
    for x0, x1, y0, y1 in walls:
        values[x0 : x1 + 1, y0 : y1 + 1] = 100
    level = LevelMap(CostmapSettings())
    level.take(values, np.zeros(2), CELL)
    return level


def random_map(seed: int) -> LevelMap:
    rng = np.random.default_rng(seed)
    corners = rng.integers(20, 170, (14, 2))
    sizes = rng.integers(0, 12, (14, 2))
    return a_map(*((x, x + a, y, y + b) for (x, y), (a, b) in zip(corners.tolist(), sizes.tolist(), strict=True)))


class Drive:
    """A vehicle that moves exactly as commanded."""

    def __init__(self, level: LevelMap, pose: tuple[float, float, float]) -> None:
        self.navigator = Navigator(level, NavigatorSettings(), LIMITS)
        self.pose, self.time, self.level = np.array(pose), 0.0, level
        self.motions: list[Motion] = []
        self.distances: list[float] = []
        self.states: list[str] = []
        self.stuck = False

    def run(self, seconds: float) -> str:
        end = self.time + seconds
        while self.time < end and self.navigator.goal is not None:
            motion = self.navigator.step(Turn(self.time, TURN, self.pose))
            if not self.stuck:
                self.pose = np.array(move_along_arc(*self.pose.tolist(), motion.speed, motion.rate, TURN))
            self.time += TURN
            self.motions.append(motion)
            self.distances.append(self.level.away(self.pose))
            self.states.append(self.navigator.state)
        return self.navigator.outcome


@pytest.mark.parametrize("seed", range(8))
def test_it_reaches_goals_within_its_limits_and_never_nearer_to_obstacles_than_its_radius(seed):
    drive = Drive(random_map(seed), (1.0, 1.0, 0.3))
    drive.navigator.set_goal(np.array([19.0, 18.5, -2.0]))
    assert drive.run(90.0) == SUCCEEDED
    assert math.dist(drive.pose[:2], (19.0, 18.5)) <= 0.25
    assert abs(math.remainder(drive.pose[2] + 2.0, math.tau)) <= 0.2
    assert min(drive.distances) >= LIMITS.radius
    speeds, rates = np.array([AT_REST, *drive.motions]).T
    assert speeds.min() >= 0.0
    assert speeds.max() <= LIMITS.speed + 1e-9
    assert np.abs(rates).max() <= LIMITS.turn_rate + 1e-9
    assert np.abs(np.diff(speeds)).max() <= LIMITS.acceleration * TURN + 1e-9
    assert np.abs(np.diff(rates)).max() <= LIMITS.turn_acceleration * TURN + 1e-9
    assert speeds.max() > 0.9 * LIMITS.speed


def test_the_same_goal_is_driven_to_bit_by_bit_in_the_same_way():
    runs = []
    for _ in range(2):
        drive = Drive(random_map(3), (1.0, 1.0, 0.0))
        drive.navigator.set_goal(np.array([19.0, 10.0, 0.0]))
        drive.run(60.0)
        runs.append(drive.motions)
    assert runs[0] == runs[1]


@pytest.mark.parametrize("seed", range(4))
def test_every_motion_that_is_chosen_can_be_stopped_before_an_obstacle(seed):
    rng, level = np.random.default_rng(seed), random_map(seed)
    clearance = LIMITS.radius + 0.5 * CELL
    chosen = 0
    for _ in range(60):
        pose = np.array([*rng.uniform(2.0, 18.0, 2), rng.uniform(-math.pi, math.pi)])
        if level.away(pose) < clearance:
            continue
        present = Motion(rng.uniform(0.0, LIMITS.speed), rng.uniform(-1.0, 1.0))
        path = np.array([pose[:2], pose[:2] + rng.uniform(-3.0, 3.0, 2)])
        motion = choose(level, LIMITS, pose, present, path, LIMITS.speed, TURN)
        if motion is None:
            continue
        chosen += 1
        stopping = motion.speed / LIMITS.acceleration
        for time in np.linspace(0.0, max(LIMITS.horizon, stopping), 80):
            # a position is up to half a cell's diagonal from the centre of its cell
            x, y, _ = move_along_arc(*pose.tolist(), motion.speed, motion.rate, float(time))
            assert level.away(np.array([x, y])) >= clearance - CELL
    assert chosen > 20


def test_the_window_is_what_can_be_reached_in_a_turn():
    speeds, rates = window(LIMITS, Motion(0.5, 0.02), LIMITS.speed, TURN)
    assert (speeds.min(), speeds.max()) == pytest.approx((0.5 - 0.04, 0.5 + 0.04))
    assert (rates.min(), rates.max()) == pytest.approx((0.02 - 0.1, 0.02 + 0.1))
    assert 0.0 in rates
    speeds, rates = window(LIMITS, Motion(0.9, 1.5), 0.2, TURN)  # beyond the limits: as near as possible
    assert (speeds.min(), speeds.max()) == pytest.approx((0.86, 0.86))
    assert (rates.min(), rates.max()) == pytest.approx((1.4, 1.4))


def test_a_motion_is_an_arc():
    x, y, yaw = move_along_arc(1.0, 2.0, 0.0, 0.5, 0.25, 2.0)  # a circle of 2 m, by 0.5 rad
    assert (x, y, yaw) == pytest.approx((1.0 + 2.0 * math.sin(0.5), 2.0 + 2.0 * (1.0 - math.cos(0.5)), 0.5))
    assert move_along_arc(1.0, 2.0, 0.5 * math.pi, 1.0, 0.0, 2.0) == pytest.approx((1.0, 4.0, 0.5 * math.pi))


@pytest.mark.parametrize("seed", range(4))
def test_global_paths_keep_their_distance_and_are_hardly_longer_than_the_straight_way(seed):
    level, start, goal = random_map(seed), np.array([1.0, 1.0]), np.array([19.0, 18.5])
    path = GlobalSearch().find(level, start, goal, 0.6)
    assert np.allclose(path[[0, -1]], [start, goal])
    assert min(level.away(point) for point in path) >= 0.6
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert length < 1.25 * math.dist(start, goal)


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        ((10.0, 5.0), "the goal is 0.0 m from an obstacle, 0.6 m are needed"),
        ((25.0, 5.0), "the goal is outside the map"),
        ((15.0, 10.0), "there is no path to the goal on the map"),
    ],
)
def test_goals_that_no_path_leads_to_are_named(goal, words):
    level = a_map((100, 100, 0, SIDE - 1))
    with pytest.raises(PathError, match=words):
        GlobalSearch().find(level, np.array([3.0, 3.0]), np.array(goal), 0.6)


def test_paths_end_at_the_nearest_place_with_a_way_within_the_tolerance():
    level = a_map((100, 100, 0, SIDE - 1))
    start, goal = np.array([3.0, 3.0]), np.array([11.0, 5.0])  # behind the wall at 10 m
    with pytest.raises(PathError, match="there is no path to the goal on the map"):
        GlobalSearch().find_near(level, start, goal, 0.6, 1.5)
    path = GlobalSearch().find_near(level, start, goal, 0.6, 2.0)
    assert math.dist(path[-1], goal) <= 2.0
    assert level.away(path[-1]) == pytest.approx(0.6, abs=CELL)
    assert path[:, 0].max() < 9.5
    open_goal = np.array([5.0, 8.0])
    assert np.array_equal(
        GlobalSearch().find_near(level, start, open_goal, 0.6, 2.0), GlobalSearch().find(level, start, open_goal, 0.6)
    )


def test_on_a_map_in_many_parts_the_nearest_reachable_place_is_found_by_one_more_search(monkeypatch):
    rng = np.random.default_rng(1)
    level = a_map(*((x, x, y, y) for x, y in np.argwhere(rng.random((SIDE, SIDE)) < 0.03).tolist()))
    start, goal, clearance = np.array([3.0, 3.0]), np.array([8.0, 18.0]), 0.4
    search, calls = GlobalSearch(), []
    find = search.find
    monkeypatch.setattr(search, "find", lambda level, *args: calls.append(args) or find(level, *args))
    place = search.find_near(level, start, goal, clearance, 20.0)[-1]
    assert len(calls) <= 2
    cells = np.argwhere(level.distance[:, :, 0] >= clearance)
    places = level.middle(cells)
    nearer = places[np.hypot(*(places - goal).T) < math.dist(place, goal) - 1e-9]
    assert len(nearer) > 1000
    for other in nearer[:: len(nearer) // 40]:
        with pytest.raises(PathError, match="no path"):
            find(level, start, other, clearance)


def test_what_was_seen_is_forgotten_and_the_given_map_is_not():
    level = a_map((50, 50, 0, SIDE - 1))
    given, distance = level.evidence.copy(), level.distance.copy()
    level.evidence[10:20, 150] = 350
    level.update_distance()
    level.forget_all()
    assert np.array_equal(level.evidence, given)
    assert np.array_equal(level.distance, distance)


def test_an_unreachable_goal_is_given_up_after_the_recoveries():
    drive = Drive(a_map((100, 100, 0, SIDE - 1)), (3.0, 3.0, 0.0))
    drive.navigator.set_goal(np.array([15.0, 10.0, 0.0]))
    assert drive.run(60.0) == ABORTED
    assert drive.navigator.reason == "there is no path to the goal on the map"
    names = [drive.states[0], *(b for a, b in zip(drive.states, drive.states[1:], strict=False) if a != b)]
    assert names == ["planning", "recovering: turning", "planning", WAITING]
    assert np.sum([motion.rate for motion in drive.motions]) * TURN == pytest.approx(math.tau, abs=0.3)
    assert drive.motions[-1] == AT_REST


def test_a_vehicle_that_does_not_move_recovers_and_then_gives_up():
    drive = Drive(a_map(), (3.0, 3.0, 0.0))
    drive.stuck = True
    drive.navigator.set_goal(np.array([15.0, 10.0, 0.0]))
    assert drive.run(60.0) == ABORTED
    assert drive.navigator.reason == "no progress along the path"


def test_a_vehicle_that_does_not_turn_at_its_goal_gives_up():
    drive = Drive(a_map(), (3.0, 3.0, 0.0))
    drive.stuck = True
    drive.navigator.set_goal(np.array([3.0, 3.0, 2.0]))
    assert drive.run(10.0) == ABORTED
    assert drive.time == pytest.approx(NavigatorSettings().patience, abs=0.3)
    assert drive.navigator.reason == "the vehicle does not turn to the goal's yaw, 2.00 rad are left"


def test_a_vehicle_that_turns_slowly_at_its_goal_is_waited_for():
    navigator = Navigator(a_map(), NavigatorSettings(), WindowSettings(turn_rate=0.1))
    drive = Drive(navigator.level, (3.0, 3.0, 0.0))
    drive.navigator = navigator
    navigator.set_goal(np.array([3.0, 3.0, 2.0]))
    assert drive.run(60.0) == SUCCEEDED
    assert drive.time > 3.0 * NavigatorSettings().patience


def test_an_obstacle_that_was_there_once_is_forgotten_by_the_recovery():
    level = a_map((0, SIDE - 1, 80, 80), (0, SIDE - 1, 120, 120))  # a corridor of 3.9 m
    drive = Drive(level, (3.0, 10.0, 0.0))
    level.evidence[60, 81:120, 0] = 350  # seen across the corridor, although there is no object
    level.update_distance()
    drive.navigator.set_goal(np.array([15.0, 10.0, 0.0]))
    assert drive.run(60.0) == SUCCEEDED


@pytest.mark.parametrize("goal", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (2e5, 0.0, 0.0)])
def test_goals_that_are_not_allowed_leave_the_present_one(goal):
    drive = Drive(a_map(), (3.0, 3.0, 0.0))
    drive.navigator.set_goal(np.array([15.0, 10.0, 0.0]))
    with pytest.raises(NavigationGoalError, match="is not allowed, finite numbers within"):
        drive.navigator.set_goal(np.array(goal))
    assert np.allclose(drive.navigator.goal, [15.0, 10.0, 0.0])


def test_a_fault_of_the_sensor_stops_the_vehicle_until_it_ends():
    drive = Drive(a_map(), (3.0, 3.0, 0.0))
    drive.navigator.set_goal(np.array([15.0, 10.0, 0.0]))
    drive.run(4.0)
    for n in range(200):
        motion = drive.navigator.step(Turn(drive.time + n * TURN, TURN, drive.pose, "sensor silent"))
    assert motion == AT_REST
    assert drive.navigator.goal is not None
    drive.time += 200 * TURN
    assert drive.run(60.0) == SUCCEEDED


def test_costs_are_those_of_costmap_2d():
    level = a_map((50, 50, 50, 50))
    level.evidence[150:, :, 0] = 0  # unknown
    costs = level.costs((slice(0, SIDE), slice(0, SIDE)), 0.4)
    assert costs[50, 50] == LETHAL
    assert costs[53, 50] == INSCRIBED
    assert costs[56, 50] == math.floor(98.0 * math.exp(-3.0 * 0.2))
    assert costs[100, 100] == 0
    assert costs[160, 100] == UNKNOWN


def test_distances_around_the_vehicle_are_those_of_the_whole_map():
    level = random_map(1)
    whole = level.distance.copy()
    level.distance[:] = 0.0
    level.update_distance_around(np.array([6.0, 7.0]))
    part = level.local(np.array([6.0, 7.0]))
    assert np.array_equal(level.distance[part], whole[part])


def scan(ranges: list[float], **changes: float) -> ScanRays:
    values = {"first": 0.0, "step": 0.5 * math.pi, "time_step": 0.0, "yaw": 0.0, **changes}
    return ScanRays(np.array(ranges), limits=(0.5, 20.0), **values)


def test_rays_without_return_count_only_beside_others_and_near_ones_not_at_all():
    assert scan([math.inf] * 4).ranges.tolist() == [20.0] * 4
    assert not scan([math.inf] * 4).hits.any()
    assert scan([3.0, math.inf, 3.0, -math.inf]).ranges.tolist() == [3.0, 3.0]
    assert scan([3.0, math.nan, 0.2, 4.0]).ranges.tolist() == [3.0, 4.0]


def test_rays_of_a_tilted_vehicle_end_at_the_slab():
    pitch = 0.2  # nose down: the ray ahead meets the ground
    pose = np.array([1.0, 2.0, 1.5, math.cos(0.5 * pitch), 0.0, math.sin(0.5 * pitch), 0.0])
    origins, ends, hits = scan([8.0, 3.0, 8.0, 3.0]).place(np.tile(pose, (2, 1)), 0.1, np.zeros(3), 0.4)
    assert hits.tolist() == [False, True, False, True]
    assert ends[0, 2] == pytest.approx(1.1)
    assert ends[1] == pytest.approx([1.0, 5.0, 1.5])
    assert origins[0] == pytest.approx([1.0, 2.0, 1.5])


def test_a_scan_marks_and_clears_but_not_what_the_given_map_has():
    level = a_map((50, 50, 0, SIDE - 1))
    pose = np.tile(np.array([3.0, 10.0, 0.0, 1.0, 0.0, 0.0, 0.0]), (2, 1))
    for distance in (1.0, 8.0):  # an object stands before the wall, and then a ray passes both
        for _ in range(10):
            level.enter(*scan([distance, 1.0, 1.0, 1.0]).place(pose, 0.1, np.zeros(3), 0.4))
        level.update_distance_around(pose[-1])
        assert (level.evidence[40, 100, 0] > 0) == (distance == 1.0)
        assert level.evidence[50, 100, 0] > 0


def test_a_map_of_other_cells_is_refused():
    level = LevelMap(CostmapSettings())
    with pytest.raises(MapError, match=r"cells of 0.05 m are not allowed, 0.1 m \(cell\)"):
        level.take(np.zeros((10, 10), np.int8), np.zeros(2), 0.05)
    with pytest.raises(MapError, match="cells of nan m"):
        level.take(np.zeros((10, 10), np.int8), np.zeros(2), math.nan)
    with pytest.raises(MapError, match=r"origin \(1e\+200, 0\) is not allowed"):
        level.take(np.zeros((10, 10), np.int8), np.array([1e200, 0.0]), CELL)
    with pytest.raises(MapError, match="0 cells are not allowed"):
        level.take(np.zeros((0, 10), np.int8), np.zeros(2), CELL)
    assert not level.is_ready


def test_an_inflation_below_the_vehicles_size_is_refused():
    check_reach(CostmapSettings(), LIMITS)
    with pytest.raises(SettingError, match=r"inflation: 0\.8 is not allowed, at least radius \+ margin, 1\.1 m"):
        check_reach(CostmapSettings(), WindowSettings(radius=1.0))


def test_action_goals_follow_each_other_as_actionlib_says():
    goals = ActionGoals()
    goals.accept("a", 1.0, 1.0)
    goals.accept("b", 2.0, 2.0)
    assert [(goal.name, goal.status) for goal in goals.results()] == [("a", action_server.PREEMPTED)]
    goals.reject("c", 3.0, "goal: too far", 3.0)
    assert goals.present is not None
    assert goals.present.name == "b"
    assert not goals.cancels("a", 0.0, 4.0)
    assert goals.cancels("b", 0.0, 4.0)
    goals.end(action_server.PREEMPTED, "cancelled", 4.0)
    assert [goal.status for goal in goals.list_recent(4.0)] == [2, 2, 5]
    assert not goals.admits("b", 2.0, 4.5)  # a late repetition
    assert goals.present is None
    assert goals.list_recent(20.0) == []


def test_goals_sent_before_a_cancel_that_overtook_them_are_recalled():
    goals = ActionGoals()
    goals.cancels("", 5.0, 5.0)
    assert not goals.admits("a", 4.0, 5.1)
    assert [(goal.name, goal.status) for goal in goals.results()] == [("a", action_server.RECALLED)]
    assert goals.admits("b", 6.0, 6.1)
    goals.accept("b", 6.0, 6.1)
    assert [goal.status for goal in goals.list_recent(6.1)] == [action_server.RECALLED, action_server.ACTIVE]
    assert goals.cancels("", 0.0, 7.0)


def test_many_rejected_goals_do_not_push_the_present_one_out_of_the_status():
    goals = ActionGoals()
    goals.accept("present", 1.0, 1.0)
    for n in range(300):
        goals.reject(f"bad-{n}", 2.0, "goal: too far", 2.0)
    listed = goals.list_recent(2.0)
    assert listed[0].name == "present"
    assert len(listed) == 101


def test_a_goal_that_is_not_admitted_does_not_turn_the_vehicle(monkeypatch: pytest.MonkeyPatch):
    silent = SimpleNamespace(Publisher=lambda *_, **__: None, Subscriber=lambda *_: None)
    monkeypatch.setattr(action_server, "lockstep", silent)
    monkeypatch.setattr(action_server.rospy, "get_time", lambda: 10.0)
    begun: list[float] = []
    topics = action_server.ActionTopics("/move_base", lambda pose: begun.append(pose.pose.position.x), lambda: None)

    def send(name: str, stamp: float, x: float) -> None:
        message = MoveBaseActionGoal(goal_id=GoalID(rospy.Time.from_sec(stamp), name))
        message.goal.target_pose.pose.position.x = x
        topics._on_goal(message)

    topics._on_cancel(GoalID(rospy.Time(5), ""))
    send("present", 6.0, 1.0)
    send("overtaken", 4.0, 2.0)
    send("present", 6.0, 3.0)
    assert begun == [1.0]
    assert topics.goals.present is not None
    assert topics.goals.present.name == "present"
