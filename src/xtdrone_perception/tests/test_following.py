"""Following in closed loop, with lags of the vehicle and the gimbal, and late or missing pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_common import frames
from xtdrone_common.cameras.camera_pose import camera_link_pose, mount_orientation, optical_pose
from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_perception.following.person_following import (
    ANY,
    FOLLOWING,
    LOST,
    SEARCHING,
    Following,
    FollowSettings,
    SeenTrack,
)
from xtdrone_perception.tracking.geolocation import Geolocator, View, cylinder_box
from xtdrone_perception.tracking.tracker import GroundDetection, Tracker

PINHOLE = Pinhole.of_view(640, 360, 2.0)
STEP = 1.0 / 30.0
LATENCY = 0.2  # s from the exposure to the tracks
PERIOD = 0.5  # s between pictures


class World:
    """A vehicle at 20 m, a person, and everything from the camera to the commands."""

    def __init__(self, seed: int, settings: FollowSettings | None = None, lost: float = 0.1) -> None:
        self.random = np.random.default_rng(seed)
        self.following, self.tracker, self.locator = Following(settings), Tracker(), Geolocator()
        self.following.follow(ANY)
        self.lost = lost
        self.time, self.next_picture = 0.0, 0.0
        self.position, self.velocity, self.yaw = np.array([0.0, 0.0, 20.0]), np.zeros(3), 0.3
        self.gimbal = np.array([-1.0, 0.0])  # pitch, yaw
        self.wanted_velocity, self.wanted_turn, self.wanted_gimbal = np.zeros(3), 0.0, self.gimbal
        self.person, self.walk, self.hidden = np.array([9.0, 4.0]), np.zeros(2), False
        self.late: list[tuple[float, list[SeenTrack]]] = []
        self.orders: list[tuple[float, str]] = []

    def view(self) -> View:
        heading = frames.quaternion_from_rpy(0.0, 0.0, self.yaw)
        mount = mount_orientation(0.0, float(self.gimbal[0]), float(self.gimbal[1]))
        link = camera_link_pose(tuple(self.position), heading, mount, (0.0, 0.0, 0.0))
        return View.of(PINHOLE, *optical_pose(link))

    def box(self) -> np.ndarray:
        return cylinder_box(self.view(), np.array([*self.person, 0.0]), 1.75, 0.28)

    @property
    def in_view(self) -> bool:
        box = self.box()
        return bool(np.isfinite(box).all() and box[:2].min() > 0 and box[2] < 640 and box[3] < 360)

    def step(self) -> None:
        self._picture()
        while self.late and self.late[0][0] <= self.time + 1e-9:
            self.following.see(self.late.pop(0)[1])
        command = self.following.update(self.time, tuple(self.position), self.yaw)
        if command.order:
            self.orders.append((self.time, command.order))
            self.wanted_velocity, self.wanted_turn = np.zeros(3), 0.0
        if command.velocity is not None:
            ahead, left, up = command.velocity
            c, s = math.cos(self.yaw), math.sin(self.yaw)
            self.wanted_velocity = np.array([c * ahead - s * left, s * ahead + c * left, up])
            self.wanted_turn = command.yaw_rate
        if command.gimbal is not None:
            self.wanted_gimbal = np.array(command.gimbal)
        self.velocity += (self.wanted_velocity - self.velocity) * STEP / 0.5
        self.position = self.position + self.velocity * STEP
        self.yaw += self.wanted_turn * STEP
        self.gimbal = self.gimbal + (self.wanted_gimbal - self.gimbal) * STEP / 0.15
        self.person = self.person + self.walk * STEP
        self.time += STEP

    def _picture(self) -> None:
        if self.time < self.next_picture - 1e-9:
            return
        self.next_picture += PERIOD
        finds = []
        view = self.view()
        if self.in_view and not self.hidden and self.random.random() >= self.lost:
            box = self.box() + self.random.normal(0.0, 1.0, 4)
            point = self.locator.locate(view, tuple(box))
            finds = [GroundDetection(point, "human", 0.9)]
        tracks = self.tracker.update(self.time, finds, lambda place: True)
        seen = [
            SeenTrack(t.id, self.time, tuple(t.position), tuple(t.velocity), t.probability)
            for t in tracks
            if t.probability
        ]
        self.late.append((self.time + LATENCY, seen))

    def wander(self) -> None:
        """Walk at up to 1.5 m/s, with sharp turns."""
        if self.random.random() < STEP / 6.0:
            angle, speed = self.random.uniform(-math.pi, math.pi), self.random.uniform(0.3, 1.5)
            self.walk = speed * np.array([math.cos(angle), math.sin(angle)])


@pytest.mark.parametrize("seed", range(3))
def test_a_walking_person_is_in_view_for_a_minute(seed):
    world = World(seed)
    views, ranges, heights = [], [], []
    world.walk = np.array([0.8, -0.9])
    while world.time < 75.0:
        world.wander()
        world.step()
        if world.time > 15.0 and len(ranges) < 3 * (world.time - 15.0):  # three per second
            views.append(world.in_view)
            ranges.append(math.dist(world.position[:2], world.person))
            heights.append(world.position[2])
    assert all(views)
    assert world.following.state == FOLLOWING
    assert world.orders == []
    assert 4.0 < min(ranges) <= max(ranges) < 17.0
    assert np.mean(ranges) == pytest.approx(10.0, abs=1.5)
    assert heights == pytest.approx([15.0] * len(heights), abs=0.3)


def test_the_distance_to_a_person_walking_straight_is_kept():
    world = World(1, lost=0.0)
    world.walk = np.array([1.5, 0.0])
    while world.time < 40.0:
        world.step()
    assert math.dist(world.position[:2], world.person) == pytest.approx(10.0, abs=0.8)
    assert world.velocity[:2] == pytest.approx([1.5, 0.0], abs=0.25)


def test_after_a_loss_the_vehicle_stops_climbs_and_finds_the_person_again():
    world = World(2, lost=0.0)
    world.walk = np.array([1.0, 0.0])
    while world.time < 20.0:
        world.step()
    first = world.following.target
    world.hidden, hidden_at = True, world.time
    while world.following.state == FOLLOWING:
        world.step()
        assert world.time < hidden_at + 3.2
    assert hidden_at + 1.4 < world.time
    ((stopped, order),) = world.orders
    assert order == "HOVER"
    while world.time < stopped + 6.0:
        world.step()
    assert world.following.state == SEARCHING
    assert np.hypot(*world.velocity[:2]) < 1e-3
    assert world.position[2] > 16.5
    world.hidden = False
    while world.following.state == SEARCHING:
        world.step()
        assert world.time < stopped + 12.0
    assert world.following.target != first  # another track of the same person
    while world.time < stopped + 40.0:
        world.step()
        assert world.in_view
    assert math.dist(world.position[:2], world.person) == pytest.approx(10.0, abs=1.5)


def seen(identity, time, x, y, velocity=(0.0, 0.0), probability=0.9) -> SeenTrack:
    return SeenTrack(identity, time, (x, y, 0.0), velocity, probability)


def test_an_unsuccessful_search_ends_in_hover():
    following = Following(FollowSettings(search=5.0))
    following.follow(ANY)
    following.see([seen(1, 0.0, 5.0, 0.0)])
    orders = []
    for k in range(100):
        command = following.update(0.1 * k, (0.0, 0.0, 15.0), 0.0)
        orders += [command.order] if command.order else []
    assert (orders, following.state) == (["HOVER", "HOVER"], LOST)
    following.see([seen(1, 9.9, 5.0, 0.0)])
    assert following.update(10.0, (0.0, 0.0, 15.0), 0.0).velocity is not None


def test_only_the_named_track_is_followed():
    following = Following()
    following.see([seen(1, 0.0, 5.0, 0.0)])
    assert following.update(0.1, (0.0, 0.0, 15.0), 0.0) == (None, 0.0, None, "")
    following.follow(2)
    following.see([seen(1, 0.2, 5.0, 0.0)])
    assert following.target == 0
    following.see([seen(1, 0.7, 5.0, 0.0), seen(2, 0.7, -5.0, 0.0)])
    assert following.target == 2
    following.see([seen(1, 1.2, 5.0, 0.0)])  # ten metres away: not the same person
    assert following.target == 2
    following.see([seen(1, 1.7, 5.0, 0.0), seen(7, 1.7, -5.5, 0.2)])
    assert following.target == 7
    assert following.stop().order == "HOVER"
    assert following.stop().order == ""
    assert following.update(2.0, (0.0, 0.0, 15.0), 0.0).velocity is None


def test_directly_above_the_person_all_commands_are_finite():
    following = Following(FollowSettings(distance=0.0))
    following.follow(ANY)
    following.see([seen(1, 0.0, 3.0, 2.0)])
    command = following.update(0.0, (3.0, 2.0, 15.0), 1.0)
    assert command.velocity == pytest.approx((0.0, 0.0, 0.0))
    assert command.gimbal == pytest.approx((-math.pi / 2, 0.0))
    back = Following(FollowSettings(distance=5.0))
    back.follow(ANY)
    back.see([seen(1, 0.0, 3.0, 2.0)])
    assert back.update(0.0, (3.0, 2.0, 15.0), 1.0).velocity == pytest.approx((-2.5, 0.0, 0.0))


@pytest.mark.parametrize("wrong", [{"height": 1.0}, {"predict": math.nan}, {"max_speed": "fast"}, {"sweep": 4.0}])
def test_invalid_settings_are_rejected(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FollowSettings(**wrong)
