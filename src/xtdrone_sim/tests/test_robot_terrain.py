"""Robots on ramps, steps and heightmaps, against closed form; starts below terrain; their URDF and frames."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from test_robots import DT, drive
from test_terrain_and_models import ramp, yaml_world

from xtdrone_common.fleet import StartPose, parse_fleet
from xtdrone_common.poses import Pose, compose, inverse
from xtdrone_common.rotation import from_euler, rotate
from xtdrone_sim.physics.contacts.start_collisions import StartError, check_height
from xtdrone_sim.physics.world import World
from xtdrone_sim.rays.solid_ground import SolidGround, shapes_of
from xtdrone_sim.robots.wheel_drives import Drive, drive_of
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.shapes.visual import Box
from xtdrone_worlds.worlds.catalogue import load_world
from xtdrone_worlds.worlds.robots.list_of_robots import parse_robots
from xtdrone_worlds.worlds.robots.robot_model import load_robot
from xtdrone_worlds.worlds.robots.robot_urdf import urdf_of, wheel_frames, wheel_joints
from xtdrone_worlds.worlds.sdf import load_world_file
from xtdrone_worlds.worlds.urdf import read_urdf


def slope(angle: float) -> SolidGround:
    """Return a wide plane through the line x = 3 m, z = 0 that rises by ``angle``, rad, along x."""
    size = Box((60.0, 60.0, 2.0))
    along, up = np.array([math.cos(angle), 0.0, math.sin(angle)]), np.array([-math.sin(angle), 0.0, math.cos(angle)])
    middle = np.array([3.0, 0.0, 0.0]) + 30.0 * along - up
    return SolidGround([(size, Pose(tuple(middle), from_euler(0.0, -angle, 0.0)))])


def step(height: float) -> SolidGround:
    """Return a step up at x = 3 m."""
    return SolidGround([(Box((10.0, 10.0, 1.0)), Pose((8.0, 0.0, height - 0.5)))])


def axis(robot: Drive) -> tuple[float, ...]:
    return rotate(robot.state.pose.orientation, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(("kind", "yaw"), [("ugv", 0.0), ("ugv", 0.6), ("car", -0.4)])
def test_a_robot_stands_on_the_plane_of_a_ramp(kind: str, yaw: float) -> None:
    angle = 0.25
    robot = drive_of(load_robot(kind), Pose((-4.0, 0.0, 0.0), from_euler(0.0, 0.0, yaw)), slope(angle))
    drive(robot, 12.0, 1.0, 0.0)
    state = robot.state
    assert state.x > 4.5
    assert axis(robot) == pytest.approx((-math.sin(angle), 0.0, math.cos(angle)), abs=1e-6)
    assert state.z == pytest.approx(math.tan(angle) * (state.x - 3.0), abs=1e-6)
    ahead = rotate(state.pose.orientation, 1.0, 0.0, 0.0)
    before = state
    _, pace, spin = robot.propose(DT)
    assert pace == pytest.approx(ahead, abs=1e-6)  # 1 m/s along its own axis
    assert spin == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    drive(robot, 1.0, 1.0, 0.3 if kind == "ugv" else 0.2)
    assert axis(robot) == pytest.approx((-math.sin(angle), 0.0, math.cos(angle)), abs=1e-6)
    way = math.dist((before.x, before.y, before.z), (robot.state.x, robot.state.y, robot.state.z))
    assert way == pytest.approx(1.0, abs=0.02)


def test_a_slope_beyond_the_limit_stops_it_and_it_drives_back() -> None:
    robot = drive_of(load_robot("ugv"), Pose(), slope(0.5))
    drive(robot, 8.0, 1.0, 0.0)
    assert robot.state.speed == 0.0
    # its castors are 0.48 m ahead and behind: the front ones are as far up the slope as the tilt allows
    assert robot.state.x == pytest.approx(3.0 - 0.48 + 0.96 * math.tan(robot.limits.slope) / math.tan(0.5), abs=0.005)
    assert math.acos(axis(robot)[2]) <= robot.limits.slope
    drive(robot, 3.0, -1.0, 0.0)
    assert robot.state.x < 0.6
    assert axis(robot) == (0.0, 0.0, 1.0)


def test_a_low_step_is_climbed_and_a_high_one_is_not() -> None:
    low, high = (drive_of(load_robot("ugv"), Pose(), step(height)) for height in (0.05, 0.07))
    for robot in (low, high):
        drive(robot, 6.0, 1.0, 0.0)
    assert low.state.z == pytest.approx(0.05)
    assert low.state.x > 4.5
    assert (high.state.z, high.state.speed) == (0.0, 0.0)
    assert high.state.x == pytest.approx(3.0 - 0.48, abs=0.01)  # its castors are 0.48 m ahead
    drive(low, 6.0, -1.0, 0.0)
    assert low.state.z == 0.0


def test_level_ground_changes_no_bit() -> None:
    pose = Pose((-20.0, 0.0, 0.0), from_euler(0.0, 0.0, 0.3))
    alone, there = drive_of(load_robot("ugv"), pose), drive_of(load_robot("ugv"), pose, step(0.3))
    for robot in (alone, there):
        drive(robot, 3.0, 1.3, 0.4)
    assert alone.state == there.state
    assert repr(alone.propose(DT)) == repr(there.propose(DT))


@pytest.fixture
def hill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return a world whose heightmap of 64 m rises by 8 m along y."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    ramp(tmp_path / "hill.png")
    return str(yaml_world(tmp_path, "  - {name: hill, heightmap: hill.png, size: [64, 64, 8]}"))


def test_a_robot_drives_up_a_heightmap(hill: str) -> None:
    ground = SolidGround(shapes_of(load_world_file(hill).models))
    assert ground.has_terrain
    robot = drive_of(load_robot("car"), Pose((5.0, -20.0, 1.5), from_euler(0.0, 0.0, 0.5 * math.pi)), ground)
    for _ in range(3):
        drive(robot, 4.0, 2.0, 0.0)
        state = robot.state
        assert state.z == pytest.approx((state.y + 32.0) / 8.0, abs=1e-3)
        assert -state.pitch == pytest.approx(math.atan(1.0 / 8.0), abs=1e-3)
        assert state.roll == pytest.approx(0.0, abs=1e-3)
    assert robot.state.y > 0.0


def test_a_start_below_the_terrain_is_refused_with_the_allowed_height(hill: str) -> None:
    def start(height: float) -> Simulation:
        return Simulation(parse_fleet("iris:1"), world=hill, places=[(0.0, 0.0, height)])

    with pytest.raises(StartError) as refused:
        start(0.0)
    words = r"iris_0: the start is not free: at 0.00 0.00 m, z = 0.00 m is below the terrain; at least (\S+) m is"
    found = re.match(words, str(refused.value))
    assert found is not None
    assert 4.0 < float(found[1]) < 4.1  # the box is 0.47 m wide
    start(float(found[1])).close()
    ground = SolidGround(shapes_of(load_world_file(hill).models))
    with pytest.raises(StartError, match=r"ugv_0: .* z = 3.00 m is below the terrain; at least 4.0[01] m is allowed"):
        check_height(ground, np.zeros((1, 2)), 3.0, "ugv_0")
    check_height(ground, np.array([[100.0, 0.0]]), -3.0, "ugv_0")  # beside it


def test_a_pose_may_have_a_height() -> None:
    first, second = parse_robots(
        "[{name: a, type: ugv, pose: [1, 2, 0.5]}, {name: b, type: ugv, pose: [1, 9, 3, 0.5]}]"
    )
    assert (first.has_height, second.has_height) == (False, True)
    assert second.pose == Pose((1.0, 9.0, 3.0), from_euler(0.0, 0.0, 0.5))


@pytest.mark.parametrize("kind", ["ugv", "car"])
def test_the_urdf_has_the_joints_of_the_joint_states(kind: str, tmp_path: Path) -> None:
    model = load_robot(kind)
    robot = drive_of(model, Pose())
    drive(robot, 1.0, 1.0, 0.3)
    path = tmp_path / "robot.urdf"
    path.write_text(urdf_of("r", model))
    urdf = read_urdf(path)
    assert urdf.root == "base_link"
    states = robot.joints()
    assert {joint.name for joint in urdf.joints} == {"platform_joint", *(state.name for state in states)}
    assert {joint.name for joint in wheel_joints(model)} == {state.name for state in states}
    assert {child for _, child, _ in wheel_frames(model, states)} == {joint.child for joint in wheel_joints(model)}
    name, child = ("left_wheel_joint", "left_wheel") if kind == "ugv" else ("rear_left_wheel_joint", "rear_left_wheel")
    angle = next(state.angle for state in states if state.name == name)
    ((parent, _, place),) = [frame for frame in wheel_frames(model, states) if frame[1] == child]
    assert (parent, place.position) == ("base_link", (0.0, 0.5 * model.limits.track, model.limits.wheel_radius))
    forward = rotate(place.orientation, 0.0, 0.0, 1.0)  # it points forward as the top has turned
    assert forward == pytest.approx((math.sin(angle), 0.0, math.cos(angle)))


@pytest.mark.parametrize("kind", ["ugv", "car"])
def test_in_the_world_a_robot_climbs_as_alone_and_a_vehicle_rides_along(kind: str, hill: str) -> None:
    model = load_world(hill)
    ground = SolidGround(shapes_of(model.models))
    robot, start = load_robot(kind), Pose((1.0, -20.0, 1.5), from_euler(0.0, 0.0, 1.3))
    there, alone = drive_of(robot, start, ground), drive_of(robot, start, ground)
    deck = robot.platform
    assert deck is not None
    x, y, z = compose(there.state.pose, Pose((robot.body.ahead, 0.0, deck.height + 0.01))).position
    attitude = (0.0, -math.atan(math.sin(1.3) / 8.0), 1.3)
    world = World(model, [load_vehicle("iris")], [StartPose(x, y, z, *attitude)], DT)
    world.add_model(7, robot.model("r", there.state.pose), there.state.pose, there)
    assert [depth for other, depth in world.overlaps(7) if depth > 0.01] == []
    for _ in range(1000):
        there.command(1.0, 0.0)
        world.bodies.wake(7)
        world.step(np.zeros((1, 8)), np.zeros(1, np.int32))
    drive(alone, 4.0, 1.0, 0.0)
    assert there.state == alone.state
    assert there.state.y > -17.5
    v = world.plant[0]
    place = compose(inverse(there.state.pose), Pose(tuple(v["position"].tolist()), tuple(v["q"].tolist())))
    assert place.position == pytest.approx((robot.body.ahead, 0.0, deck.height + 0.055), abs=0.05)
    assert place.orientation[0] > 0.998
