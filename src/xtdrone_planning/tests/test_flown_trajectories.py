"""Vehicles on trajectories that keep clear of each other and of obstacles pass the safety filter uncorrected."""

from __future__ import annotations

import math

import numpy as np
import pytest
import rospy
from geometry_msgs.msg import Point
from toy_flight import PERIOD, ToyFlight, forest
from toy_swarm import Group

from xtdrone_control.network.network_options import NetworkOptions
from xtdrone_planning.planner_settings import AgreementSettings
from xtdrone_planning.safety.near_points import without_vehicles
from xtdrone_planning.safety.trajectory_clearance import FARTHEST, TrajectoryClearance
from xtdrone_planning.safety.velocity_filter import SafetySettings, VelocityFilter
from xtdrone_planning.trajectories.flown_trajectories import FlownTrajectories
from xtdrone_planning.trajectories.moving_vehicles import MovingVehicles
from xtdrone_planning.trajectories.splines.uniform_spline import UniformSpline, coasting, resting
from xtdrone_planning.trajectories.trajectory_messages import TrajectoryError, spline_message, spline_of

DISTANCE, TRACKING, RADIUS = 1.0, 0.5, 0.4  # m
EAST, WEST, NORTH = np.array([4.5, 0.0, 0.0]), np.array([-4.5, 0.0, 0.0]), np.array([0.0, 3.0, 0.0])
SETTINGS = SafetySettings(distance=DISTANCE, obstacle_distance=0.65, tracking=TRACKING)


def meeting(aside: float) -> tuple[FlownTrajectories, np.ndarray]:
    """Return two vehicles that meet after 3 s at a lateral distance, m, and their positions at time 0."""
    places = np.array([[-13.5, 0.0, 2.0], [13.5, aside, 2.0]])
    trajectories = FlownTrajectories(2, DISTANCE, TRACKING)
    for index, velocity in enumerate((EAST, WEST)):
        trajectories.on_trajectory(index, 1, coasting(places[index], velocity, 0.0), RADIUS)
    return trajectories, places


def test_two_that_pass_beside_each_other_need_no_braking():
    trajectories, places = meeting(1.4)
    safety = VelocityFilter(SETTINGS, 1.0 / 30.0)
    for now in np.arange(0.0, 6.0, 0.1):
        at = places + np.stack([EAST, WEST]) * now
        trajectories.update(at, now)
        assert trajectories.commands(0, at[0] + 0.2 * EAST)
        agreed = np.array([trajectories.agreed(0, 1)])
        assert not safety.check(EAST, at[0], at[1:], WEST[None], agreed=agreed).corrected
    assert safety.check(EAST, np.zeros(3), np.array([[8.0, 1.4, 0.0]]), WEST[None]).corrected  # without trajectories


def test_how_far_vehicles_are_off_counts_against_the_distance_and_how_late_they_are_does_not():
    for off, agreed in ((0.1, True), (0.25, False)):
        trajectories, places = meeting(1.4)
        trajectories.update(places + np.array([[0.0, off, 0.0], [0.0, -off, 0.0]]), 0.0)
        assert trajectories.agreed(0, 1) == agreed
    trajectories, places = meeting(1.4)
    trajectories.update(places + 0.2 * np.stack([EAST, WEST]), 0.4)
    assert trajectories.flown(0).off == pytest.approx(0.0, abs=1e-9)
    assert trajectories.agreed(1, 0)


def test_trajectories_that_come_too_near_or_a_vehicle_off_its_own_are_not_agreed_on():
    trajectories, places = meeting(0.9)
    trajectories.update(places, 0.0)
    assert not trajectories.agreed(0, 1)
    trajectories, places = meeting(3.0)
    trajectories.update(places + np.array([[0.0, 0.0, 0.0], [0.0, 0.0, TRACKING + 0.1]]), 0.0)
    assert trajectories.flown(1) is None
    assert not trajectories.agreed(0, 1)
    assert not trajectories.commands(1, places[1])


def test_two_that_cross_at_different_times_are_agreed_on_until_one_is_late():
    for late, agreed in ((0.0, True), (1.0, False)):
        trajectories = FlownTrajectories(2, DISTANCE, TRACKING)
        trajectories.on_trajectory(0, 1, coasting(np.array([-9.0, 0.0, 2.0]), EAST, 0.0), RADIUS)
        north = coasting(np.array([0.0, -9.0, 2.0]), NORTH, late - 2.0)  # crosses at 1 + late s, the first at 2 s
        trajectories.on_trajectory(1, 1, north, RADIUS)
        trajectories.update(np.array([[-9.0, 0.0, 2.0], north.at(0.0)[0]]), 0.0)
        assert trajectories.agreed(0, 1) == agreed


def test_a_trajectory_counts_from_its_start_on_and_setpoints_may_be_of_the_next():
    trajectories, places = meeting(3.0)
    turned = coasting(places[0] + EAST, NORTH, 1.0)
    trajectories.update(places, 0.0)
    trajectories.on_trajectory(0, 2, turned, RADIUS)
    trajectories.update(places + 0.9 * np.stack([EAST, WEST]), 0.9)
    assert trajectories.flown(0).spline.points[-1, 1] == 0.0
    assert trajectories.commands(0, turned.at(1.1)[0])
    assert not trajectories.commands(0, turned.at(1.1)[0] + (0.0, 0.0, 0.2))
    assert not trajectories.commands(0, None)  # a velocity setpoint
    trajectories.on_trajectory(0, 2, turned, RADIUS)  # repeated
    trajectories.update(np.stack([turned.at(1.2)[0], places[1] + 1.2 * WEST]), 1.2)
    assert trajectories.flown(0).spline.points[-1, 1] > 0.0
    assert trajectories.commands(0, turned.at(1.4)[0])


def late_by_a_new_trajectory(aside: float) -> FlownTrajectories:
    """Return two vehicles of which the first, 0.3 s late, still has to pass the other, so far beside it, before its new
    trajectory leads away; the other hovers."""
    trajectories, there = FlownTrajectories(2, DISTANCE, TRACKING), np.array([-0.5, aside, 2.0])
    first = coasting(np.array([-9.0, 0.0, 2.0]), EAST, 0.0)
    trajectories.on_trajectory(0, 1, first, RADIUS)
    trajectories.on_trajectory(1, 1, resting(there, 0.0), RADIUS)
    trajectories.update(np.stack([first.at(0.0)[0], there]), 0.0)
    turn = first.at(2.0)[0]
    ahead = (-0.9, 0.0), (0.0, 0.0), (0.9, 0.0), *[(0.9, -6.0)] * 4
    points = turn + np.array([(x, y, 0.0) for x, y in ahead])
    trajectories.on_trajectory(0, 2, UniformSpline(2.0, 0.2, points), RADIUS)
    trajectories.update(np.stack([first.at(1.75)[0], there]), 2.05)
    return trajectories


def test_what_a_late_vehicle_still_flies_before_its_new_trajectory_is_checked_too():
    trajectories = late_by_a_new_trajectory(3.0)
    flown = trajectories.flown(0)
    assert flown.spline.start == pytest.approx(2.3)
    assert flown.at(2.2) is flown.before
    assert flown.at(2.4) is flown.spline
    assert trajectories.agreed(0, 1)
    near = late_by_a_new_trajectory(0.88)
    flown, other = near.flown(0).spline, MovingVehicles([near.flown(1).spline], [DISTANCE])
    assert other.conflict_time(flown, flown.start) == math.inf
    assert not near.agreed(0, 1)


def test_a_planner_that_was_restarted_counts_from_1_and_its_trajectory_is_flown():
    trajectories, places = meeting(3.0)
    trajectories.update(places, 0.0)
    again = coasting(places[0] + 2.0 * EAST, NORTH, 2.0)
    trajectories.on_trajectory(0, 1, again, RADIUS)
    trajectories.update(np.stack([again.at(2.5)[0], places[1] + 2.5 * WEST]), 2.5)
    assert trajectories.flown(0).spline.points is again.points


def test_the_distance_to_obstacles_is_that_of_a_fine_search():
    generator = np.random.default_rng(4)
    points = generator.uniform((-2.0, -3.0, 0.0), (12.0, 3.0, 4.0), (60, 3))
    spline = UniformSpline(5.0, 0.5, np.cumsum(generator.uniform((0.2, -0.6, -0.1), (1.2, 0.6, 0.1), (16, 3)), axis=0))
    clearance = TrajectoryClearance()
    for now in (4.0, 6.0, 8.0, 11.0):
        places = spline.positions(np.arange(max(now, spline.start), spline.end, 0.002))
        exact = np.linalg.norm(places[:, None] - points, axis=2).min()
        assert clearance.least(spline, points, now) == pytest.approx(min(exact, FARTHEST), abs=0.05)
    assert clearance.least(resting(np.zeros(3), 0.0), np.empty((0, 3)), 1.0) == FARTHEST


def test_a_trajectory_that_is_too_long_to_be_checked_is_not_clear():
    points = np.outer((1.0, -1.0, 1.0, -1.0, 1.0), np.full(3, 1e9))
    far_away = np.full((1, 3), 1e6)
    assert TrajectoryClearance().least(UniformSpline(0.0, 1.0, points), far_away, 0.5) == 0.0


def test_a_trajectory_at_rest_is_clear():
    assert TrajectoryClearance().least(resting(np.zeros(3), 0.0), np.full((1, 3), 1e6), 0.5) == FARTHEST


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"interval": 1e300}, r"interval: 1e\+300 is not allowed, above 0 and at most 3600 s"),
        ({"interval": math.nan}, "interval: nan"),
        ({"radius": math.nan}, "radius: nan is not allowed, above 0 m and finite"),
        ({"radius": 0.0}, "radius: 0 is not allowed"),
        ({"start": rospy.Time(4_000_000_000)}, r"start: 4e\+09 s from now is not allowed, at most 60 s"),
        ({"control_points": [Point(0.0, 0.0, math.inf)] * 4}, "control_points: numbers beyond"),
        ({"control_points": [Point()] * 3}, "control_points: 3 are not allowed, 4 to 10000"),
    ],
)
def test_a_message_that_is_no_usable_trajectory_is_refused(changes, text):
    message = spline_message(resting(np.zeros(3), 5.0), "iris_0", 1, RADIUS, rospy.Time(5), "map")
    assert np.array_equal(spline_of(message, 5.0).points, np.zeros((4, 3)))
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(TrajectoryError, match=text):
        spline_of(message, 5.0)


def test_points_at_known_vehicles_are_no_obstacles():
    points = np.array([[3.0, 0.0, 2.0], [3.3, 0.0, 2.0], [5.0, 0.0, 2.0]])
    kept = without_vehicles(points, np.array([[3.0, 0.1, 2.0], [np.nan] * 3]), 0.35)
    assert kept.tolist() == [[5.0, 0.0, 2.0]]


class GuardedFlight(ToyFlight):
    """A vehicle that follows setpoints as PX4 does, behind the safety filter."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.filter = VelocityFilter(SETTINGS, PERIOD)
        self.clearance_check = TrajectoryClearance()
        self.points = np.empty((0, 3))
        self.corrected = 0

    def step(self) -> None:
        """Plan a turn; the vehicle moves in ``pass_on``."""
        position, velocity, count = self.position, self.velocity, len(self.commands)
        super().step()
        self.command = self.commands[-1] if len(self.commands) > count else None
        self.position, self.velocity = position, velocity

    def pass_on(self, index: int, trajectories: FlownTrajectories, places: np.ndarray, velocities: np.ndarray) -> None:
        """Fly on within the filter's limits."""
        if self.command is None:
            return
        target, speed, acceleration, _ = self.command
        wanted = speed + 0.95 * (target - self.position)
        if self.turn % 10 == 0:
            self.points = np.ascontiguousarray(self.map.grid.occupied())  # as of a cloud
        points, rest = self.points, np.arange(len(places)) != index
        follows = trajectories.commands(index, target)
        agreed = np.array([follows and trajectories.agreed(index, k) for k in np.flatnonzero(rest)])
        flown = trajectories.flown(index)
        clear = follows and self.clearance_check.least(flown.spline, points, self.time) >= flown.radius + flown.off
        verdict = self.filter.check(
            wanted, self.position, places[rest], velocities[rest], points, agreed, is_clear=clear
        )
        self.corrected += verdict.corrected
        if verdict.corrected:
            change = (verdict.velocity - self.velocity) / 0.55
        else:
            change = acceleration + (wanted - self.velocity) / 0.55
        self.velocity = self.velocity + PERIOD * change
        self.position = self.position + PERIOD * self.velocity
        self.track[-1] = self.position


class GuardedGroup(Group):
    """Vehicles behind safety filters."""

    trajectories = FlownTrajectories(2, DISTANCE, TRACKING)

    def after_turn(self, now: float) -> None:
        """Pass the setpoints on."""
        places = np.array([flight.position for flight in self.flights])
        velocities = np.array([flight.velocity for flight in self.flights])
        for index, flight in enumerate(self.flights):
            if flight.planner.trajectory is not None:
                self.trajectories.on_trajectory(index, flight.planner.number, flight.planner.trajectory, RADIUS)
        self.trajectories.update(places, now)
        for index, flight in enumerate(self.flights):
            flight.pass_on(index, self.trajectories, places, velocities)


@pytest.mark.parametrize(("tracking", "seconds"), [(TRACKING, 30.0), (0.0, 7.0)])
def test_two_planners_pass_each_other_among_trunks_uncorrected(tracking, seconds):
    swarm = AgreementSettings(check=0.2, separation=0.6)
    group = GuardedGroup(2, NetworkOptions(), swarm, length=28.0, trunks=forest(2, 30), kind=GuardedFlight)
    group.trajectories = FlownTrajectories(2, DISTANCE, tracking)
    arrived = math.isfinite(group.run(seconds))
    corrected = sum(flight.corrected for flight in group.flights)
    if tracking == 0.0:  # as without trajectories
        assert corrected > 10
        return
    assert arrived
    assert corrected == 0
    assert group.least > 1.2
    assert min(flight.clearance() for flight in group.flights) > RADIUS + 0.1
