"""Vehicles start at the fleet's poses, on free ground, and so do their autopilots' estimates."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_common.fleet import parse_fleet, with_poses
from xtdrone_common.rotation import to_euler
from xtdrone_sim.physics.contacts.start_collisions import StartError
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.descriptions import ModelError

MODELS = """<sdf version="1.6"><world name="w">
<model name="tower"><static>true</static><pose>10 0 1 0 0 0</pose><link name="l"><collision name="c"><geometry>
  <box><size>2 2 2</size></box></geometry></collision></link></model>
<model name="ball"><static>true</static><pose>20 0 0 0 0 0</pose><link name="l"><collision name="c"><geometry>
  <sphere><radius>1</radius></sphere></geometry></collision></link></model>
<model name="mast"><static>true</static><pose>30 0 5 0 0 0</pose><link name="l"><collision name="c"><geometry>
  <cylinder><radius>0.5</radius><length>10</length></cylinder></geometry></collision></link></model>
<model name="ramp"><static>true</static><pose>40 0 0 0 0 0</pose><link name="l"><collision name="c"><geometry>
  <mesh><uri>wedge.obj</uri></mesh></geometry></collision></link></model>
</world></sdf>"""
WEDGE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nv 1 -1 1\nv 1 1 1\n" + "".join(
    f"f {face}\n" for face in ("1 3 2", "1 4 3", "2 3 6", "2 6 5", "1 5 6", "1 6 4", "1 2 5", "4 6 3")
)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("world")
    (folder / "wedge.obj").write_text(WEDGE)
    (folder / "w.world").write_text(MODELS)
    return str(folder / "w.world")


def start(poses: str, world: str = "empty", **options: bool) -> Simulation:
    return Simulation(with_poses(parse_fleet("iris:2"), poses), world=world, **options)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        ("[[0, 5], [10, 0]]", r"iris_1: the start is not free: .* centred at 10\.00 .* is 0\.11 m inside 'tower'"),
        ("[[20, 0.3], [0, 0]]", r"iris_0: .* is 0\.\d\d m inside 'ball'"),
        ("[[30, 0.6, 1], [0, 0]]", r"iris_0: .* is 0\.13 m inside 'mast'"),
        ("[[40, 0, 0.4], [0, 0]]", r"iris_0: .* inside 'ramp'"),
        ("[[0, 0], [0.3, 0.1, 0, 0, 0, 0.5]]", r"iris_1: .* is 0\.11 m inside iris_0"),
        ("[[0, 0, -0.3], [5, 5]]", r"iris_0: .* is 0\.30 m below the ground"),
        ("[[5, 5], [0, 0, 0, 0.5]]", r"iris_1: .* is 0\.11 m below the ground"),
    ],
)  # fmt: skip
def test_a_start_that_is_not_free_is_refused(world: str, poses: str, message: str) -> None:
    with pytest.raises(StartError, match=message):
        start(poses, world)


def test_an_unknown_model_is_refused_with_a_list_of_the_known() -> None:
    with pytest.raises(ModelError, match=r"vehicles: 'iris_sonar' is not known; there are iris, iris_2d_lidar, .*solo"):
        Simulation(parse_fleet("[{name: iris_0, model: iris_sonar}]"))


def test_a_model_flies_under_another_name() -> None:
    simulation = Simulation(parse_fleet("[{type: iris}, {type: iris, model: typhoon_h480}]"))
    assert [vehicle.name for vehicle in simulation.fleet] == ["iris_0", "iris_1"]
    assert [int(model.record["rotor_count"]) for model in simulation.models] == [4, 6]
    simulation.close()


def test_a_start_beside_and_on_a_model_is_free(world: str) -> None:
    simulation = start("[[10, 0, 2], [30, 0.9]]", world)
    simulation.run_until(2_000_000)
    assert simulation.world.plant["position"][0] == pytest.approx([10.0, 0.0, 2.055], abs=0.01)
    simulation.close()


@pytest.mark.parametrize("shared", [True, False])
def test_home_and_local_origin_fit_the_start(shared: bool) -> None:
    """A vehicle hovers above its rotated start pose; home and the local origin are where it stood."""
    poses = ((-40.0, 25.0, 0.0, 0.0, 0.0, 2.0), (30.0, -60.0, 0.3, 0.0, 0.0, -1.0))
    simulation = start(str([list(pose) for pose in poses]), shared_datum=shared)
    simulation.run_until(10_000_000)
    for i, (x, y, _, _, _, yaw) in enumerate(poses):
        truth, estimate = simulation.world.plant[i], simulation.autopilot.estimator[i]
        assert truth["position"] == pytest.approx([x, y, 0.055], abs=0.01)
        assert to_euler(truth["q"].tolist())[2] == pytest.approx(yaw, abs=0.01)
        north, east, _ = estimate["position"].tolist()
        wanted = (y, x) if shared else (0.0, 0.0)
        assert (north, east) == pytest.approx(wanted, abs=1.0)
        heading = math.pi / 2 - to_euler(estimate["q"].tolist())[2]
        assert math.remainder(heading - yaw, 2 * math.pi) == pytest.approx(0.0, abs=0.1)
        commander = simulation.commanders[i]
        assert commander.arm_disarm(True) == 0
        home = commander.home
        assert np.asarray(home.position[:2], float) == pytest.approx([north, east], abs=0.5)
    simulation.close()


@pytest.mark.parametrize("height", [1.0, 5.0])
def test_a_vehicle_that_falls_to_the_ground_aligns_at_rest(height: float) -> None:
    simulation = Simulation(parse_fleet("iris:1"), places=[(0.0, 3.0, height)])
    simulation.run_until(10_000_000)
    estimate, truth = simulation.autopilot.estimator[0], simulation.world.plant[0]
    x, y, z = truth["position"].tolist()
    assert estimate["position"].tolist() == pytest.approx([y, x, -z], abs=0.1)
    assert float(np.linalg.norm(estimate["velocity"])) < 0.1
    assert simulation.commanders[0].ready_to_arm
    simulation.close()
