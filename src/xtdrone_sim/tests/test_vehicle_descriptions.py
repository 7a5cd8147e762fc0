"""Vehicles from URDF and YAML: parsing, rejections, user-defined vehicles, the hexacopter in flight."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from xtdrone_autopilot.state import FAILURE_OFF
from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose, compose, inverse, rotate
from xtdrone_common.rotation import from_euler
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.tf.vehicle_frames import RobotFrames
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.data_files import data_path
from xtdrone_worlds.descriptions import ModelError, available, read_description
from xtdrone_worlds.shapes.visual import Box, Cylinder
from xtdrone_worlds.worlds.urdf import UrdfError, parse_urdf

TYPHOON = "typhoon_h480"
DUMB_BELL = """<robot name="dumb-bell">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="bar"/>
  <link name="left">
    <inertial><mass value="2"/><inertia ixx="0.1" iyy="0.2" izz="0.3"/></inertial>
    <visual><origin xyz="0 0 1"/><geometry><box size="1 2 3"/></geometry><material name="red"/></visual>
  </link>
  <link name="right">
    <inertial><mass value="2"/><inertia ixx="0.1" iyy="0.2" izz="0.3"/></inertial>
    <visual><geometry><cylinder radius="1" length="2"/></geometry></visual>
  </link>
  <joint name="a" type="fixed"><parent link="bar"/><child link="left"/><origin xyz="0 3 0" rpy="0 0 1.5707963"/></joint>
  <joint name="b" type="revolute"><parent link="bar"/><child link="right"/><origin xyz="0 -3 0"/>
    <axis xyz="0 0 2"/><limit lower="-1" upper="2" velocity="4" effort="1"/></joint>
</robot>"""


def test_poses_compose_and_undo():
    pose = Pose((1.0, -2.0, 3.0), from_euler(0.3, -0.4, 1.2))
    back = compose(pose, inverse(pose))
    np.testing.assert_allclose(back.position, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.abs(back.orientation), [1.0, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(rotate(from_euler(0.0, 0.0, math.pi / 2), (1.0, 0.0, 0.0)), [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(rotate(from_euler(0.0, math.pi / 2, 0.0), (1.0, 0.0, 0.0)), [0.0, 0.0, -1.0], atol=1e-12)


def test_urdf_of_a_dumb_bell():
    bell = parse_urdf(DUMB_BELL, Path("bell.urdf"))
    assert bell.root == "bar"
    mass, centre, inertia = bell.mass()
    assert mass == 4.0
    np.testing.assert_allclose(centre, 0.0, atol=1e-12)
    # the left one is turned by 90 degrees: its x is the bar's y; 2 kg at 3 m each
    np.testing.assert_allclose(inertia, np.diag([0.1 + 0.2 + 36.0, 0.2 + 0.1, 0.6 + 36.0]), atol=1e-6)
    assert [link.name for link in bell.moving] == ["bar", "right"]
    fixed, own = bell.moving[0].visuals[0], bell.moving[1].visuals[0]
    assert fixed.geometry == Box((1.0, 2.0, 3.0))
    assert fixed.colour == (1.0, 0.0, 0.0, 1.0)
    np.testing.assert_allclose(fixed.pose.position, [0.0, 3.0, 1.0])
    assert own.geometry == Cylinder(1.0, 2.0)
    joint = bell.joint("b")
    assert (joint.axis, joint.lower, joint.upper, joint.velocity) == ((0.0, 0.0, 1.0), -1.0, 2.0, 4.0)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('size="1 2 3"', 'size="1 2"', "link 'left', visual 1, <box> size: '1 2' is not allowed, 3 numbers"),
        ('size="1 2 3"', 'size="1 2 -3"', "above 0"),
        ('radius="1"', 'radius="wide"', "link 'right', visual 1, <cylinder> radius: 'wide' is not allowed, a number"),
        ('<mass value="2"/>', "", "link 'left', inertial: element <mass> is missing"),
        (
            'type="revolute"',
            'type="prismatic"',
            "joint 'b', type: 'prismatic' is not allowed, fixed, revolute, continuous",
        ),
        ('<child link="right"/>', '<child link="wrong"/>', "joint 'b': link 'wrong' does not exist"),
        ('<child link="right"/>', '<child link="left"/>', "'left' is given 2 times"),
        (
            '<parent link="bar"/><child link="left"/>',
            '<parent link="left"/><child link="left"/>',
            "the joints form a loop",
        ),
        ('<limit lower="-1"', '<limit lower="1"', "lower 1, upper 2 is not allowed"),
        ('<material name="red"/>', '<material name="blue"/>', "material 'blue' has no colour"),
        ('rgba="1 0 0 1"', 'rgba="255 0 0 1"', "0 to 1"),
        ('<box size="1 2 3"/>', '<mesh filename="a.dae"/>', "'a.dae' is not allowed, a file that ends with .obj"),
        ('<box size="1 2 3"/>', '<mesh filename="package://nowhere_here/a.obj"/>', "no ROS package 'nowhere_here'"),
        ('<box size="1 2 3"/>', '<mesh filename="gone.obj"/>', "there is no file"),
        ("</robot>", "", "not XML"),
    ],
)
def test_urdf_rejects(old, new, words):
    assert old in DUMB_BELL
    with pytest.raises(UrdfError) as raised:
        parse_urdf(DUMB_BELL.replace(old, new, 1), Path("bell.urdf"))
    assert "bell.urdf" in str(raised.value)
    assert words in str(raised.value)


def test_typhoon_is_fitted_as_upstream():
    model = load_vehicle(TYPHOON)
    (camera,) = model.cameras
    assert (camera.name, camera.link, camera.frame_id) == (
        "cgo3_camera",
        "cgo3_camera_link",
        "cgo3_camera_optical_frame",
    )
    assert (camera.pinhole.width, camera.pinhole.height) == (640, 360)
    assert camera.pinhole.fx == pytest.approx(205.4696, abs=1e-4)
    assert model.gimbal.link == camera.link
    assert model.record["rotor_count"] == 6
    assert model.record["mass"] == pytest.approx(2.02 + 0.4 + 0.2 + 6 * 0.005)
    names = [link.name for link in model.urdf.moving]
    legs, gimbal = ["left_leg", "right_leg"], ["vertical_arm", "horizontal_arm", "camera"]
    assert names == ["base_link", *legs, *(f"cgo3_{part}_link" for part in gimbal)]
    for i, place in enumerate(model.record["rotor_position"][:6]):  # a rotor's visual is where its thrust acts
        np.testing.assert_allclose(model.urdf.joint(f"rotor_{i}_joint").pose.position, place)


@pytest.mark.parametrize("name", sorted(path.stem for path in data_path("config/vehicles").glob("*.yaml")))
def test_every_vehicle_of_the_package_can_be_loaded(name):
    model = load_vehicle(name)
    assert model.urdf.root == "base_link"
    assert model.urdf.moving[0].visuals


@pytest.mark.parametrize("name", sorted(path.stem for path in data_path("config/vehicles").glob("*.yaml")))
def test_inertias_are_complete_as_other_readers_of_urdf_want_them(name):
    for inertia in ElementTree.fromstring(load_vehicle(name).urdf.text or "<robot/>").iter("inertia"):
        assert set(inertia.attrib) == {"ixx", "ixy", "ixz", "iyy", "iyz", "izz"}


@pytest.mark.parametrize("name", ["iris", TYPHOON])
def test_every_link_has_a_pose_before_the_first_joint_state(name):
    model = load_vehicle(name)
    frames = RobotFrames(name, model)
    placed = {frame.child for frame in (*frames.fixed, *frames.at_rest())}
    assert {f"{name}/{link.name}" for link in model.urdf.links} <= {frames.body, *placed}
    for frame in frames.at_rest():
        joint = next(joint for joint in model.urdf.joints if frame.child == f"{name}/{joint.child}")
        assert frame.pose.position == pytest.approx(joint.pose.position)
        assert frame.pose.orientation == pytest.approx(joint.pose.orientation)


# user-defined vehicles


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XTDRONE_VEHICLES", str(tmp_path))
    return tmp_path


def write(folder: Path, name: str, changes: dict) -> None:
    (folder / f"{name}.yaml").write_text(yaml.safe_dump({"extends": TYPHOON, **changes}))


def test_a_copy_with_longer_arms(own_folder):
    urdf = (data_path(f"models/{TYPHOON}") / f"{TYPHOON}.urdf").read_text()
    (own_folder / "wide.urdf").write_text(urdf.replace("0.0019 0.2427 0.122", "0.0019 0.35 0.122"))
    rotors = read_description("vehicles", TYPHOON)["rotors"]
    rotors[1]["position"][1] = 0.35
    write(own_folder, "wide", {"urdf": "wide.urdf", "rotors": rotors, "mass": 3.0})
    assert "wide" in available("vehicles")
    wide, typhoon = load_vehicle("wide"), load_vehicle(TYPHOON)
    assert wide.name == "wide"
    assert wide.record["mass"] == 3.0
    assert wide.record["inertia"][0] > typhoon.record["inertia"][0], "a rotor weighs, further out"
    assert wide.urdf.joint("rotor_1_joint").pose.position[1] == 0.35
    assert wide.cameras == typhoon.cameras
    simulation = Simulation(parse_fleet("wide:1,typhoon_h480:1"))
    simulation.run_until(100_000)
    assert simulation.world.models["rotor_position"][0, 1, 1] == 0.35
    simulation.close()


def test_one_s_own_vehicle_goes_before_the_package_s(own_folder):
    write(own_folder, "iris", {"extends": "iris", "mass": 9.0})
    assert load_vehicle("iris").record["mass"] == 9.0
    assert load_vehicle("iris").record["rotor_count"] == 4


def test_robot_description_names_files_that_any_node_finds(own_folder):
    (own_folder / "part.obj").write_text("v 0 0 0\n")
    text = DUMB_BELL.replace('<box size="1 2 3"/>', '<mesh filename="part.obj"/>')
    bell = parse_urdf(text, own_folder / "bell.urdf")
    assert f'filename="file://{own_folder.resolve()}/part.obj"' in bell.text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mass": -1.0}, "mass: -1.0 is not allowed, it must be positive"),
        ({"urdf": "gone.urdf"}, "urdf: 'gone.urdf' does not exist; searched in"),
        (
            {"urdf": "iris/iris.urdf", "mass": 1.0, "inertia": [1, 1, 1]},
            "link 'cgo3_camera_link' does not exist; there are",
        ),
        (
            {"urdf": "iris/iris.urdf", "cameras": [], "gimbal": None},
            "mass: urdf is not allowed, no link of the URDF has",
        ),
        ({"cameras": {"name": "x"}}, "cameras: {'name': 'x'} is not allowed, a list"),
        ({"cameras": [{"name": "x"}]}, "cameras, number 1: field 'height' is missing"),
        (
            {"gimbal": {"yaw": "cgo3_camera_joint", "roll": "a", "pitch": "b"}},
            "gimbal: typhoon_h480: joint 'a' does not exist",
        ),
        ({"gimbal": {"rate": 0.0}}, "gimbal: rate: 0.0 is not allowed, 0.01 to 100 rad/s"),
        ({"gimbal": {"yaw": "rotor_0_joint"}}, "yaw joint 'rotor_0_joint' of type fixed is not allowed"),
        ({"gimbal": {"yaw": "cgo3_camera_joint"}}, "axis 0 1 0 is not allowed, 0 0 1 or its opposite"),
        ({"gimbal": {"speed": 1.0}}, "gimbal: field 'speed' is not known"),
        ({"extends": "own"}, "extends: 'own' is not allowed, it refers back to"),
    ],
)
def test_yaml_rejects(own_folder, changes, words):
    write(own_folder, "own", changes)
    with pytest.raises(ModelError) as raised:
        load_vehicle("own")
    assert words in str(raised.value)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("link", "nose", "link 'nose' does not exist; there are base_link"),
        ("hfov", 4.0, "horizontal_fov: 4.0 is not allowed, 0.01 to 3.1 rad"),
        ("rate", 0.0, "rate: 0.0 is not allowed, 0.1 to 50 Hz"),
        ("far", 0.01, "far: 0.01 is not allowed"),
    ],
)
def test_a_camera_is_rejected(own_folder, field, value, words):
    camera = {**read_description("vehicles", TYPHOON)["cameras"][0], field: value}
    write(own_folder, "own", {"cameras": [camera]})
    with pytest.raises(ModelError, match=r"cameras, number 1 \(cgo3_camera\)") as raised:
        load_vehicle("own")
    assert words in str(raised.value)


def test_a_missing_folder_is_reported(monkeypatch):
    monkeypatch.setenv("XTDRONE_VEHICLES", "/nowhere/at/all")
    with pytest.raises(ModelError, match="XTDRONE_VEHICLES: '/nowhere/at/all' is not a folder"):
        load_vehicle("iris")


# in flight


@pytest.fixture(scope="module")
def hovering():
    simulation = Simulation(parse_fleet(f"{TYPHOON}:1"), seed=1)
    simulation.run_until(2_000_000)
    (commander,) = simulation.commanders
    commander.parameters.set("MIS_TAKEOFF_ALT", 6.0)
    assert commander.request(modes.AUTO_TAKEOFF) == 0
    assert commander.arm_disarm(True) == 0
    simulation.run_until(16_000_000)
    yield simulation
    simulation.close()


def test_hexacopter_hovers_at_the_closed_form(hovering):
    model = hovering.world.models[0]
    speed = math.sqrt(model["mass"] * hovering.world.model.gravity / (6 * model["thrust_constant"]))
    expected = (speed - model["idle_speed"]) / model["input_scaling"]
    given = []
    for _ in range(100):
        hovering.run_until(hovering.time_us + 20_000)
        given.append(hovering.autopilot.control["actuators"][0, :6].copy())
    assert np.mean(given) == pytest.approx(expected, rel=0.005)
    assert load_vehicle(TYPHOON).parameters["MPC_THR_HOVER"] == pytest.approx(expected, rel=0.005)


def test_hexacopter_flies_a_square_and_holds_in_wind(hovering):
    (commander,) = hovering.commanders
    unset = (math.nan, math.nan, math.nan)
    start = np.array(commander.view.estimator["position"])

    def fly(goal: np.ndarray, seconds: float) -> float:
        """Return the greatest distance of the truth from ``goal`` (NED, m) in the last second."""
        worst = 0.0
        for tick in range(round(seconds * 50)):
            commander.offboard.set_trajectory(tuple(goal), unset, unset, 0.0, math.nan)
            hovering.run_until(hovering.time_us + 20_000)
            x, y, z = hovering.world.plant["position"][0]
            if tick >= 50 * (seconds - 1):
                worst = max(worst, float(np.linalg.norm(np.array([y, x, -z]) - goal)))
        return worst

    fly(start, 0.1)
    assert commander.request(modes.OFFBOARD) == 0
    for corner in ((4.0, 0.0), (4.0, 4.0), (0.0, 4.0), (0.0, 0.0)):
        assert fly(start + np.array([*corner, 0.0]), 6.0) < 0.2
    hovering.world.plant["wind"][0] = (6.0, 0.0, 0.0)
    assert fly(start, 15.0) < 0.3
    hovering.world.plant["wind"][0] = 0.0
    assert fly(start, 15.0) < 0.2


def test_hexacopter_remains_upright_without_a_motor(hovering):
    """Yaw control is given up: the vehicle turns on the spot, and holds its position and height."""
    (commander,) = hovering.commanders
    commander.request(modes.AUTO_LOITER)
    hovering.run_until(hovering.time_us + 2_000_000)
    start = hovering.world.plant["position"][0].copy()
    hovering.autopilot.failures["motor"][0, 0] = FAILURE_OFF
    tilt = []
    for _ in range(500):
        hovering.run_until(hovering.time_us + 20_000)
        _, x, y, _ = hovering.world.plant["q"][0]
        tilt.append(math.degrees(math.acos(1.0 - 2.0 * (x * x + y * y))))
    assert max(tilt) < 40.0
    assert max(tilt[-50:]) < 10.0
    assert commander.armed
    np.testing.assert_allclose(hovering.world.plant["position"][0], start, atol=1.0)
