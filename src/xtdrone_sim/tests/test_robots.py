"""Ground robots: motion against closed form, obstacles and carried vehicles, descriptions and listings."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.fleet import StartPose
from xtdrone_common.poses import Pose, compose
from xtdrone_common.rotation import from_euler, yaw_of
from xtdrone_sim.physics.world import World
from xtdrone_sim.rays.scene import RayScene, SceneAt
from xtdrone_sim.robots.wheel_drives import Ackermann, Differential, Drive, drive_of
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.shapes.visual import Box, Collision
from xtdrone_worlds.worlds.catalogue import load_world
from xtdrone_worlds.worlds.robots.list_of_robots import parse_robots
from xtdrone_worlds.worlds.robots.robot_model import load_robot, robot_types
from xtdrone_worlds.worlds.robots.robot_settings import AckermannLimits, DifferentialLimits
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel

DT = 0.004


def drive(robot: Drive, seconds: float, linear: float, angular: float) -> None:
    for _ in range(round(seconds / DT)):
        robot.command(linear, angular)
        robot.propose(DT)
        robot.accept()


def differential(**values: float) -> Differential:
    return Differential(DifferentialLimits(**values), Pose((1.0, 2.0, 0.0), from_euler(0.0, 0.0, 0.3)))


# kinematics


@pytest.mark.parametrize(("speed", "rate"), [(1.0, 0.5), (-0.7, 0.9), (2.0, -0.05), (0.0, 1.2), (1.5, 0.0)])
def test_a_differential_drive_moves_on_the_arc_of_its_command(speed: float, rate: float) -> None:
    robot = differential(acceleration=50.0, turn_acceleration=500.0)  # a step of 0.04 s to 2 m/s
    drive(robot, 1.0, speed, rate)
    start, way = robot.state, 3.0
    assert (start.speed, start.rate) == (speed, rate)
    drive(robot, way, speed, rate)
    end, turned = robot.state, start.yaw + rate * way
    if rate:
        x = start.x + speed / rate * (math.sin(turned) - math.sin(start.yaw))
        y = start.y - speed / rate * (math.cos(turned) - math.cos(start.yaw))
    else:
        x, y = start.x + speed * way * math.cos(start.yaw), start.y + speed * way * math.sin(start.yaw)
    assert (end.x, end.y) == pytest.approx((x, y), abs=1e-9)
    assert math.remainder(end.yaw - turned, math.tau) == pytest.approx(0.0, abs=1e-9)
    wheel, half = robot.limits.wheel_radius, 0.5 * robot.limits.track
    assert end.left - start.left == pytest.approx((speed - rate * half) * way / wheel)
    assert end.right - start.right == pytest.approx((speed + rate * half) * way / wheel)


def test_speed_follows_within_the_acceleration() -> None:
    """After t the speed is at most a t; a stop from v takes v^2 / (2 a), to within one step."""
    robot = differential(acceleration=2.0, speed=3.0)
    drive(robot, 0.5, 99.0, 0.0)
    assert robot.state.speed == pytest.approx(1.0)
    drive(robot, 3.0, 99.0, 0.0)
    assert robot.state.speed == 3.0
    before = robot.state
    drive(robot, 3.0, 0.0, 0.0)
    assert robot.state.speed == 0.0
    way = math.hypot(robot.state.x - before.x, robot.state.y - before.y)
    assert way == pytest.approx(9.0 / 4.0, abs=3.0 * DT)
    assert robot.is_still


def test_a_robot_stops_without_commands() -> None:
    robot = differential(timeout=0.5, acceleration=50.0)
    robot.command(1.0, 1.0)
    for _ in range(100):
        robot.propose(DT)
        robot.accept()
    assert robot.state.speed == 1.0
    for _ in range(100):
        robot.propose(DT)
        robot.accept()
    assert (robot.state.speed, robot.state.rate) == (0.0, 0.0)
    lasting = differential(timeout=0.0, acceleration=50.0)
    lasting.command(1.0, 0.0)
    for _ in range(2000):
        lasting.propose(DT)
        lasting.accept()
    assert lasting.state.speed == 1.0


@pytest.mark.parametrize("steering", [0.4, -0.2])
def test_a_car_drives_the_circle_of_its_steering_angle(steering: float) -> None:
    limits = AckermannLimits(acceleration=50.0, steering_rate=50.0, speed=5.0, wheelbase=2.62, track=1.29)
    car = Ackermann(limits)
    drive(car, 1.0, 3.0, steering)
    radius = limits.wheelbase / math.tan(steering)
    start = car.state
    middle = np.array([start.x - radius * math.sin(start.yaw), start.y + radius * math.cos(start.yaw)])
    for _ in range(10):
        drive(car, 0.5, 3.0, steering)
        assert np.hypot(*(np.array([car.state.x, car.state.y]) - middle)) == pytest.approx(abs(radius), abs=1e-9)
    assert car.state.rate == pytest.approx(3.0 / radius)
    joints = {joint.name: joint for joint in car.joints()}
    for side, name in ((-0.5, "left"), (0.5, "right")):  # every wheel is at right angles to its ray from the middle
        assert joints[f"front_{name}_steering_joint"].angle == pytest.approx(
            math.atan(limits.wheelbase / (radius + side * limits.track))
        )
        speed = 3.0 * math.hypot(radius + side * limits.track, limits.wheelbase) / abs(radius)
        assert joints[f"front_{name}_wheel_joint"].rate == pytest.approx(speed / limits.wheel_radius)
        rear = 3.0 * (radius + side * limits.track) / radius
        assert joints[f"rear_{name}_wheel_joint"].rate == pytest.approx(rear / limits.wheel_radius)


def test_a_car_does_not_turn_on_the_spot_and_keeps_its_angle_without_commands() -> None:
    car = Ackermann(AckermannLimits(steering=0.5, timeout=0.1))
    drive(car, 2.0, 0.0, 2.0)
    assert (car.state.x, car.state.y, car.state.yaw) == (0.0, 0.0, 0.0)
    assert car.state.steering == 0.5
    assert car.is_still
    for _ in range(100):
        car.propose(DT)
        car.accept()
    assert car.state.steering == 0.5


@pytest.mark.parametrize(("linear", "angular"), [(math.nan, 0.0), (0.0, math.inf)])
def test_a_command_that_is_no_number_changes_nothing(linear: float, angular: float) -> None:
    robot = differential(acceleration=50.0)
    robot.command(1.0, 0.0)
    with pytest.raises(ValueError, match="is not allowed, a finite number"):
        robot.command(linear, angular)
    robot.propose(DT)
    robot.accept()
    assert robot.state.speed == pytest.approx(0.2)


# in the world


def wall(x: float, mass_less: bool = True) -> SdfModel:
    shape = Collision(Box((0.4, 6.0, 2.0)))
    return SdfModel("wall", Pose((x, 0.0, 1.0)), mass_less, (SdfLink("l", collisions=(shape,)),))


class Scene:
    """A world with one iris and robots at poses."""

    def __init__(self, robots: dict[str, Pose], start: StartPose, models: tuple[SdfModel, ...] = ()) -> None:
        model = load_world("empty")
        model = type(model)(**{**model.__dict__, "models": models})
        self.world = World(model, [load_vehicle("iris")], [start], DT)
        self.drives: list[Drive] = []
        self.first = len(models)
        for number, (kind, pose) in enumerate(robots.items()):
            robot = load_robot(kind.rstrip("0123456789"))
            self.drives.append(drive_of(robot, pose))
            self.world.add_model(self.first + number, robot.model(kind, pose), pose, self.drives[-1])

    def run(self, seconds: float, *commands: tuple[float, float]) -> None:
        for _ in range(round(seconds / DT)):
            for number, (robot, command) in enumerate(zip(self.drives, commands, strict=False)):
                robot.command(*command)
                self.world.bodies.wake(self.first + number)
            self.world.step(np.zeros((1, 8)), np.zeros(1, np.int32))


def test_in_the_world_a_robot_moves_as_alone_to_the_last_bit() -> None:
    pose = Pose((10.0, 0.0, 0.0), from_euler(0.0, 0.0, 0.5))
    scene, alone = Scene({"ugv": pose}, StartPose(0.0, 0.0)), drive_of(load_robot("ugv"), pose)
    scene.run(3.0, (1.5, 0.6))
    drive(alone, 3.0, 1.5, 0.6)
    assert scene.drives[0].state == alone.state
    body = scene.world.bodies.by_number[0]
    assert body.pose == alone.state.pose
    assert math.hypot(*body.velocity) == pytest.approx(1.5, rel=1e-4)
    scene.run(5.0)
    assert not scene.world.is_busy  # it stands still, and needs no steps


def test_a_vehicle_on_the_platform_rides_along() -> None:
    """Straight on, through a curve, and to a stop, it stays at its place on the platform."""
    deck = load_robot("ugv").platform
    assert deck is not None
    scene = Scene({"ugv": Pose()}, StartPose(0.1, -0.1, deck.height + 0.01))
    scene.run(1.0)
    v = scene.world.plant[0]
    assert v["position"][2] == pytest.approx(deck.height + 0.055, abs=0.01)
    assert (0, 1) in scene.world.collisions
    robot = scene.drives[0]
    place = lambda: rotated(v["position"][:2] - (robot.state.x, robot.state.y), -robot.state.yaw)  # noqa: E731
    begin = place()
    scene.run(4.0, (1.0, 0.0))
    assert robot.state.x > 3.0
    assert v["velocity"][0] == pytest.approx(1.0, abs=0.02)
    scene.run(3.0, (1.0, 0.5))
    assert v["velocity"][:2] == pytest.approx([math.cos(robot.state.yaw), math.sin(robot.state.yaw)], abs=0.1)
    yaw = yaw_of(v["q"].tolist())
    assert math.remainder(yaw - robot.state.yaw, math.tau) == pytest.approx(0.0, abs=0.05)
    scene.run(3.0)
    assert place() == pytest.approx(begin, abs=0.05)
    assert v["position"][2] == pytest.approx(deck.height + 0.055, abs=0.01)
    scene.run(1.0)
    assert not scene.world.is_busy


def rotated(vector: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


@pytest.mark.parametrize("kind", ["ugv", "car"])
def test_a_wall_stops_a_robot_which_can_drive_back(kind: str) -> None:
    scene = Scene({kind: Pose((10.0, 0.0, 0.0))}, StartPose(0.0, 20.0), (wall(16.0),))
    scene.run(6.0, (2.0, 0.0))
    robot, body = scene.drives[0], load_robot(kind)
    deck = body.platform
    assert deck is not None
    front = body.body.ahead + 0.5 * max(body.body.length, deck.length)
    assert robot.state.x + front == pytest.approx(15.8, abs=0.03)
    assert abs(robot.state.speed) < 0.05
    scene.run(2.0, (-1.0, 0.0))
    assert robot.state.x < 15.8 - front - 1.0


def test_robots_stop_each_other_and_push_what_moves() -> None:
    crate = SdfModel(
        "crate", Pose((8.0, 0.0, 0.5)), False, (SdfLink("l", collisions=(Collision(Box((1.0, 1.0, 1.0))),)),)
    )
    facing = from_euler(0.0, 0.0, math.pi)
    scene = Scene(
        {"ugv": Pose((0.0, 0.0, 0.0)), "ugv2": Pose((20.0, 0.3, 0.0), facing)}, StartPose(0.0, 20.0), (crate,)
    )
    scene.run(7.0, (1.0, 0.0))
    assert scene.world.bodies.by_number[0].pose.position[0] == pytest.approx(scene.drives[0].state.x + 1.2, abs=0.2)
    scene = Scene({"ugv": Pose((0.0, 0.0, 0.0)), "ugv2": Pose((5.0, 0.3, 0.0), facing)}, StartPose(0.0, 20.0))
    scene.run(6.0, (1.0, 0.0), (1.0, 0.0))
    apart = scene.drives[1].state.x - scene.drives[0].state.x
    assert apart == pytest.approx(1.4, abs=0.05)  # two half platforms


def test_a_robot_pushes_a_vehicle_that_sleeps_in_its_way() -> None:
    scene = Scene({"ugv": Pose((-6.0, 0.0, 0.0))}, StartPose(0.0, 0.0))
    scene.run(2.0)
    assert not scene.world.is_busy
    scene.run(9.0, (1.0, 0.0))
    assert scene.world.plant[0]["position"][0] > scene.drives[0].state.x + 0.5
    assert (0, 1) in scene.world.collisions


def test_a_robot_that_is_put_elsewhere_drives_on_from_there() -> None:
    scene = Scene({"ugv": Pose((10.0, 0.0, 0.0))}, StartPose(0.0, 0.0))
    scene.world.place_model(0, Pose((5.0, 6.0, 0.0), from_euler(0.0, 0.0, 1.0)), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    scene.run(1.0, (1.0, 0.0))
    state = scene.drives[0].state
    assert math.atan2(state.y - 6.0, state.x - 5.0) == pytest.approx(1.0)


def test_rays_see_a_robot_where_it_is() -> None:
    robot, pose = load_robot("ugv"), Pose((5.0, 1.0, 0.0), from_euler(0.0, 0.0, 0.7))
    rays = RayScene([])
    rays.change([robot.model("ugv_0", Pose())], [])
    scene = SceneAt({"ugv_0::base_link": compose(pose, Pose())}, {})
    hits = rays.cast(np.array([[5.0, 1.3, 4.0]]), np.array([[0.0, 0.0, -1.0]]), 10.0, scene=scene)
    assert hits.ranges == pytest.approx([3.5])
    assert rays.owners[hits.owners[0]] == "ugv_0"


# descriptions and listings


def test_the_packages_robots_are_possible() -> None:
    assert robot_types() == ["boat", "car", "ugv", "ugv_tags"]
    for kind in robot_types()[1:]:
        model = load_robot(kind).model("x_0", Pose((1.0, 2.0, 0.0)))
        low = min(shape.pose.position[2] - 0.5 * shape.geometry.size[2] for shape in model.links[0].collisions)  # type: ignore[union-attr]
        assert low > 0.04  # above the ground
    assert isinstance(drive_of(load_robot("car"), Pose()), Ackermann)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("drive: tracked", "drive: 'tracked' is not allowed, differential, ackermann or boat"),
        ("{}", "drive: None is not allowed"),
        ("drive: differential\nlimits: {speed: fast}", "limits speed: 'fast' is not allowed, 0.01 to 50 m/s"),
        (
            "drive: differential\nlimits: {wheelbase: 2}",
            "limits: {'wheelbase': 2} is not allowed, a mapping with wheel_r",
        ),
        (
            "drive: ackermann\nlimits: {steering: 1.4, track: 3, wheelbase: 0.2}",
            "limits steering: 1.4 is not allowed, below",
        ),
        ("drive: differential\nbody: {clearance: 0}", "body clearance: 0 is not allowed, 0.05 to 5 m"),
        (
            "drive: differential\nbody: {height: 0.1, clearance: 0.2}",
            "body height: 0.1 is not allowed, above clearance",
        ),
        (
            "drive: differential\nplatform: {height: 0.2}",
            "platform height: 0.2 is not allowed, at least body and plate",
        ),
        ("drive: differential\nplatform: [1]", "platform: [1] is not allowed, a mapping with length"),
        ("drive: differential\nwings: 2", "field 'wings' is not known; there are drive, limits, body, platform"),
    ],
)
def test_a_wrong_description_is_named(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(ModelError) as caught:
        load_robot(str(path))
    assert str(caught.value).startswith(f"robot {path}: {words}")


def test_robots_by_count_and_by_list(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("extends: ugv\nlimits: {speed: 1}\n")
    robots = parse_robots("ugv:2,car")
    assert [robot.name for robot in robots] == ["ugv_0", "ugv_1", "car_0"]
    assert len({robot.pose for robot in robots}) == 3
    listed = parse_robots(f"[{{name: ugv_7, type: {tmp_path}/mine.yaml, pose: [1, 2, 0.5]}}]")
    assert listed[0].model.limits.speed == 1.0
    assert listed[0].pose == Pose((1.0, 2.0, 0.0), from_euler(0.0, 0.0, 0.5))
    assert parse_robots("") == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ugv:", "robots: 'ugv:' is not allowed, TYPE:COUNT, comma-separated"),
        ("ugv:-1", "robots: 'ugv:-1' is not allowed, TYPE:COUNT"),
        ("ugv:51", "robots: 'ugv:51' is not allowed, at most 50 robots"),
        ("tank:1", "robots: type 'tank' is not known; there are boat, car, ugv, ugv_tags, or a YAML file"),
        ("[{type: ugv}]", r"robots\[0\] name: None is not allowed, a letter"),
        ("[{name: a/b, type: ugv}]", r"robots\[0\] name: 'a/b' is not allowed"),
        ("[{name: a, type: ugv}, {name: a, type: car}]", "robots: 'a' is not allowed, a name that no other robot has"),
        ("[{name: a, type: ugv, pose: [1]}]", r"robots: a: pose: \[1\] is not allowed, x, y, m, and optionally yaw"),
        ("[{name: a, type: ugv, pose: [1, .nan]}]", "robots: a: pose: nan is not allowed"),
        ("[{name: a, kind: ugv}]", "is not allowed, a mapping with name, type, pose"),
        ("[1", "is not allowed, a YAML list: line 1"),
    ],
)
def test_a_wrong_listing_is_named(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_robots(text)


def test_a_start_inside_something_is_found() -> None:
    """Overlaps with a vehicle, a wall and another robot are found; a vehicle on the platform is none."""
    scene = Scene({"ugv": Pose((0.5, 0.0, 0.0)), "ugv2": Pose((1.0, 0.0, 0.0))}, StartPose(0.0, 0.0), (wall(1.2),))
    found = dict(scene.world.overlaps(1))
    assert found.keys() == {0, 1, 3}  # the vehicle, the wall, the other robot
    assert found[0] > 0.03
    assert found[3] > 0.2  # the shortest way out, upwards
    alone = Scene({"ugv": Pose((0.0, 0.0, 0.0))}, StartPose(0.0, 0.0, 0.505))
    assert alone.world.overlaps(0) == []
