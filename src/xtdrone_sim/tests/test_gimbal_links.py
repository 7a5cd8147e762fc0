"""Gimbals against their law, links against the poses in their URDF, landing gears in flight."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from xtdrone_common import modes
from xtdrone_common.cameras.camera_pose import camera_link_pose, mount_orientation
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose, compose, rotate
from xtdrone_common.rotation import from_euler
from xtdrone_sim.physics.vehicle_dynamics import PLANT
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.gimbals_and_landing_gears import Gimbals, LandingGears
from xtdrone_sim.vehicles.link_poses import Links
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.descriptions import ModelError

STEP = 0.004
MODEL = load_vehicle("typhoon_h480")
CAMERA = "typhoon_h480_0::cgo3_camera_link"


class Rig:
    """A gimbal on a body with a given attitude."""

    def __init__(self) -> None:
        self.plant = np.zeros(1, PLANT)
        self.payload = SimpleNamespace(gimbal=(math.nan,) * 3, gimbal_attitude=None)
        self.gimbals = Gimbals([MODEL])
        self.links = Links(["typhoon_h480_0"], [MODEL])
        self.gears = LandingGears([MODEL]).records
        self._commanders = [SimpleNamespace(navigator=SimpleNamespace(payload=self.payload))]
        self.turn(0.0, 0.0, 0.0)

    def turn(self, roll: float, pitch: float, yaw: float) -> None:
        """Set the body's attitude: FLU in ENU, rad."""
        self.plant["q"] = from_euler(roll, pitch, yaw)

    def run(self, seconds: float) -> None:
        for step in range(round(seconds / STEP)):
            self.gimbals.step(step, self.plant, self._commanders, STEP)

    def camera(self) -> Pose:
        state = self.links.place(self.plant, self.gimbals.records, self.gears)[self.links.find(CAMERA)]
        w, x, y, z = state["q"].tolist()
        return Pose(tuple(state["position"].tolist()), (w, x, y, z))

    def looks(self) -> np.ndarray:
        """Return the camera's axes x (forward), y (left) and z (up) in the world, as columns."""
        return np.column_stack([rotate(self.camera().orientation, axis) for axis in np.eye(3).tolist()])


def turn_of(heading: float, roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the camera's axes by the definition of roll, pitch (up) and yaw (to the right)."""
    return np.column_stack([rotate(from_euler(roll, -pitch, heading - yaw), axis) for axis in np.eye(3).tolist()])


@pytest.mark.parametrize("body", [(0.0, 0.0, 0.0), (0.3, -0.2, 1.0), (-0.4, 0.35, -2.5), (0.1, 0.5, 3.1)])
@pytest.mark.parametrize("wanted", [(0.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, -math.pi / 2, 0.0), (0.0, -0.7, 2.0)])
def test_the_camera_holds_the_commanded_direction_for_every_attitude(body, wanted):
    rig = Rig()
    rig.turn(*body)
    rig.payload.gimbal = wanted
    rig.run(3.0)
    roll, pitch, yaw = body
    ahead = rotate(from_euler(roll, pitch, yaw), (1.0, 0.0, 0.0))
    heading = math.atan2(ahead[1], ahead[0])
    np.testing.assert_allclose(rig.looks(), turn_of(heading, *wanted), atol=1e-6)
    np.testing.assert_allclose(rig.payload.gimbal_attitude, wanted, atol=1e-6)


def test_the_reported_orientation_gives_the_cameras_pose():
    """MAVROS's mount orientation and the vehicle's pose give the camera's pose."""
    rig = Rig()
    rig.plant["position"] = (10.0, -4.0, 30.0)
    rig.turn(0.15, -0.1, 2.0)
    rig.payload.gimbal = (0.3, -0.9, -0.6)
    rig.run(3.0)
    w, x, y, z = rig.plant["q"][0].tolist()
    camera = rig.camera()
    told = camera_link_pose(
        (10.0, -4.0, 30.0), (w, x, y, z), mount_orientation(*rig.payload.gimbal_attitude), (0, 0, 0)
    )
    assert abs(np.dot(told.orientation, camera.orientation)) == pytest.approx(1.0, abs=1e-9)
    assert math.dist(told.position, camera.position) < 0.15  # of its offset from the body's origin


def test_the_camera_is_level_and_ahead_without_a_command():
    rig = Rig()
    rig.turn(0.2, 0.2, 0.5)
    rig.run(1.0)
    np.testing.assert_allclose(rig.payload.gimbal_attitude, 0.0, atol=1e-9)


def test_it_turns_at_its_rate():
    rig = Rig()
    rig.payload.gimbal = (0.0, -1.5, 0.0)
    rig.run(0.5)
    assert rig.payload.gimbal_attitude[1] == pytest.approx(-0.5 * MODEL.gimbal.rate, abs=0.03)
    rig.run(1.0)
    assert rig.payload.gimbal_attitude[1] == pytest.approx(-1.5, abs=1e-9)


def test_joint_limits_hold():
    rig = Rig()
    rig.payload.gimbal = (0.0, 1.5, 0.0)  # the pitch joint's limit is 1.05 upwards
    rig.run(2.0)
    assert rig.payload.gimbal_attitude[1] == pytest.approx(1.05, abs=1e-6)
    rig.turn(1.2, 0.0, 0.0)  # more than the roll joint can compensate
    rig.payload.gimbal = (0.0, 0.0, 0.0)
    rig.run(2.0)
    assert rig.payload.gimbal_attitude[0] == pytest.approx(1.2 - 0.785398, abs=1e-3)


def test_a_turning_body_s_heading_is_followed():
    rig = Rig()
    for k in range(500):  # once around and more, at 3.5 rad/s
        rig.turn(0.1, 0.05, 3.5 * k * STEP)
        rig.run(STEP)
    np.testing.assert_allclose(rig.payload.gimbal_attitude, 0.0, atol=0.08)
    assert float(rig.gimbals.records["joint"][0, 0]) == pytest.approx(0.0, abs=0.1)


def test_links_are_where_the_urdf_puts_them():
    rig = Rig()
    rig.plant["position"] = (1.0, 2.0, 3.0)
    rig.turn(0.2, -0.3, 0.7)
    rig.gimbals.records["joint"] = (0.5, -0.2, 0.9)
    urdf, pose = MODEL.urdf, Pose((1.0, 2.0, 3.0), from_euler(0.2, -0.3, 0.7))
    for name, turn in (
        ("cgo3_mount_joint", (0.0, 0.0, 0.0)),
        ("cgo3_vertical_arm_joint", (0.0, 0.0, 0.5)),
        ("cgo3_horizontal_arm_joint", (-0.2, 0.0, 0.0)),
        ("cgo3_camera_joint", (0.0, 0.9, 0.0)),
    ):
        pose = compose(compose(pose, urdf.joint(name).pose), Pose(orientation=from_euler(*turn)))
    camera = rig.camera()
    np.testing.assert_allclose(camera.position, pose.position, atol=1e-12)
    assert abs(np.dot(camera.orientation, pose.orientation)) == pytest.approx(1.0, abs=1e-12)


def test_velocities_of_links_are_those_of_their_poses():
    rig = Rig()
    rig.plant["velocity"] = (1.0, -2.0, 0.5)
    rig.plant["rates"] = (0.4, -0.3, 0.8)
    rig.turn(0.2, -0.3, 0.7)
    rig.gimbals.records["joint"] = (0.5, -0.2, 0.9)
    rig.gimbals.records["joint_rate"] = (1.0, 0.5, -0.7)
    number = rig.links.find(CAMERA)
    told = rig.links.place(rig.plant, rig.gimbals.records, rig.gears)[number].copy()
    before = rig.camera()
    dt = 1e-6
    rig.plant["position"] += dt * rig.plant["velocity"]
    body = Pose(orientation=from_euler(0.2, -0.3, 0.7))
    turned = compose(body, Pose(orientation=from_euler(*(dt * rig.plant["rates"][0]).tolist())))
    rig.plant["q"] = turned.orientation
    rig.gimbals.records["joint"] += dt * rig.gimbals.records["joint_rate"]
    after = rig.camera()
    np.testing.assert_allclose((np.array(after.position) - before.position) / dt, told["velocity"], atol=1e-4)
    spun = rotate(from_euler(*(dt * told["spin"]).tolist()), rotate(before.orientation, (1.0, 2.0, 3.0)))
    np.testing.assert_allclose(spun, rotate(after.orientation, (1.0, 2.0, 3.0)), atol=1e-9)


def test_links_of_a_mixed_fleet_and_of_a_fixed_camera(tmp_path: Path):
    (tmp_path / "eyed.yaml").write_text(
        "extends: iris\nurdf: eyed.urdf\ncameras: [{name: down, link: eye, width: 64, height: 48, hfov: 1.0}]\n"
    )
    (tmp_path / "eyed.urdf").write_text(
        '<robot name="eyed"><link name="base_link"/><link name="eye"/><joint name="j" type="fixed">'
        '<parent link="base_link"/><child link="eye"/><origin xyz="0 0 -0.05" rpy="0 1.5707963267948966 0"/>'
        "</joint></robot>"
    )
    eyed = load_vehicle(str(tmp_path / "eyed.yaml"))
    links = Links(["typhoon_h480_0", "eyed_0"], [MODEL, eyed])
    assert links.names[-2:] == ["eyed_0::base_link", "eyed_0::eye"]
    assert links.find("eyed_0") == links.find("eyed_0::base_link")
    assert links.find("nobody") is None
    plant = np.zeros(2, PLANT)
    plant["q"][:, 0] = 1.0
    plant["position"][1] = (5.0, 0.0, 2.0)
    state = links.place(plant, Gimbals([MODEL, eyed]).records, LandingGears([MODEL, eyed]).records)[-1]
    np.testing.assert_allclose(state["position"], (5.0, 0.0, 1.95))
    w, x, y, z = state["q"].tolist()
    np.testing.assert_allclose(rotate((w, x, y, z), (1.0, 0.0, 0.0)), (0.0, 0.0, -1.0), atol=1e-9)


def test_the_simulation_turns_the_gimbal_and_reports_to_the_autopilot():
    simulation = Simulation(parse_fleet("iris:1,typhoon_h480:1"))
    payload = simulation.commanders[1].navigator.payload
    simulation.run_until(100_000)
    assert payload.gimbal_attitude == pytest.approx((0.0, 0.0, 0.0), abs=0.02)
    payload.gimbal_manager.look((0.0, math.radians(-60.0), 0.0))
    simulation.run_until(2_000_000)
    assert payload.gimbal_attitude == pytest.approx((0.0, math.radians(-60.0), 0.0), abs=1e-3)
    assert simulation.commanders[0].navigator.payload.gimbal_attitude is None, "the iris has none"
    simulation.restart()
    simulation.run_until(20_000)
    assert simulation.commanders[1].navigator.payload.gimbal_attitude[1] == pytest.approx(0.0, abs=0.05)
    simulation.close()


def test_legs_that_are_up_are_where_their_joints_turn_them():
    rig = Rig()
    rig.turn(0.2, -0.3, 0.7)
    rig.gears["raised"], rig.gears["rate"] = 0.6, 0.5
    states = rig.links.place(rig.plant, rig.gimbals.records, rig.gears)
    body = Pose(orientation=from_euler(0.2, -0.3, 0.7))
    for name, side in (("left", 1.0), ("right", -1.0)):
        joint = MODEL.urdf.joint(f"{name}_leg_joint")
        angle = 0.6 * joint.upper * side
        wanted = compose(compose(body, joint.pose), Pose(orientation=from_euler(angle, 0.0, 0.0)))
        state = states[rig.links.find(f"typhoon_h480_0::{name}_leg")]
        np.testing.assert_allclose(state["position"], wanted.position, atol=1e-12)
        w, x, y, z = state["q"].tolist()
        assert abs(np.dot((w, x, y, z), wanted.orientation)) == pytest.approx(1.0, abs=1e-12)
        turn = rotate(body.orientation, (0.5 * joint.upper * side, 0.0, 0.0))
        np.testing.assert_allclose(state["spin"], turn, atol=1e-12)


def _raised(simulation: Simulation) -> float:
    return float(simulation.landing_gears.records["raised"][0])


def test_the_landing_gear_is_up_in_flight_and_down_to_land():
    """As in PX4, it is up in AUTO modes from 2 m above home, down when the vehicle lands, otherwise unchanged."""
    simulation = Simulation(parse_fleet("typhoon_h480:1"), seed=2)
    commander = simulation.commanders[0]
    commander.parameters.set("MIS_TAKEOFF_ALT", 6.0)
    simulation.run_until(8_000_000)
    commander.request(modes.AUTO_TAKEOFF)
    commander.arm_disarm(True)
    plant = simulation.world.plant
    while plant["position"][0, 2] < 1.8:
        simulation.run_until(simulation.time_us + 100_000)
        assert _raised(simulation) == 0.0
        assert simulation.time_us < 30_000_000, "it does not take off"
    simulation.run_until(simulation.time_us + 6_000_000)
    assert _raised(simulation) == 1.0
    commander.request(modes.AUTO_LAND)
    simulation.run_until(simulation.time_us + 2_500_000)
    assert _raised(simulation) == 0.0
    assert plant["position"][0, 2] > 0.5, "down before it is on the ground"
    simulation.close()


@pytest.mark.parametrize("joints", ["left_leg_joint", [7], ["rotor_0_joint"], ["cgo3_vertical_arm_joint"]])
def test_a_landing_gear_of_other_joints_is_rejected(tmp_path: Path, joints):
    (tmp_path / "odd.yaml").write_text(f"extends: typhoon_h480\nlanding_gear: {joints}\n")
    with pytest.raises(ModelError, match=r"landing_gear: .*(not allowed|does not exist)"):
        load_vehicle(str(tmp_path / "odd.yaml"))
