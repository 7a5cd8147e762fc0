"""The autopilot's range finder and flow camera above objects of the world."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from test_estimator_flights import UNSET, Flight

from xtdrone_common import modes
from xtdrone_common.fleet import parse_fleet
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.shapes.visual import Box, Collision
from xtdrone_worlds.worlds import people_meshes
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel

WORLD = """<sdf version="1.6"><world name="w">
<model name="table"><static>true</static><pose>10 0 1 0 0 0</pose><link name="link">
<collision name="c"><geometry><box><size>2 2 0.2</size></box></geometry></collision>
<visual name="v"><geometry><box><size>2 2 0.2</size></box></geometry></visual></link></model>
<model name="ramp"><static>true</static><pose>20 0 0 0 -0.3 0</pose><link name="link">
<visual name="v"><geometry><box><size>8 8 2</size></box></geometry></visual></link></model>
</world></sdf>"""


def world_file(folder: Path) -> str:
    path = folder / "w.world"
    path.write_text(WORLD)
    return str(path)


def quiet(fleet: str, world: str) -> Simulation:
    """Return a simulation whose range finder has no noise."""
    simulation = Simulation(parse_fleet(fleet), world=world)
    simulation.world.models["range_noise"] = 0.0
    return simulation


def distance(simulation: Simulation, position, q=(1.0, 0.0, 0.0, 0.0)) -> float:
    v = simulation.world.plant[0]
    v["position"], v["q"] = position, q
    simulation.sensors.sample(0, 0)
    return float(simulation.autopilot.sensors["range_distance"][0])


def test_the_range_is_that_to_the_model_below(tmp_path):
    simulation = quiet("iris_rangefinder:1", world_file(tmp_path))
    assert distance(simulation, (0.0, 0.0, 5.0)) == pytest.approx(5.0)
    assert distance(simulation, (10.9, 0.9, 5.0)) == pytest.approx(3.9, abs=1e-6)
    assert distance(simulation, (11.1, 0.0, 5.0)) == pytest.approx(5.0)
    assert distance(simulation, (10.0, 0.0, 0.5)) == pytest.approx(0.5)  # under the table
    tilted = from_euler(0.0, -0.3, 0.0)  # at right angles to the ramp, whose surface is 1 m from its middle
    normal = np.array([-np.sin(0.3), 0.0, np.cos(0.3)])
    assert distance(simulation, (20.0, 0.0, 0.0) + 6.0 * normal, tilted) == pytest.approx(5.0, abs=1e-6)
    simulation.close()


def test_models_that_are_moved_added_and_removed_are_seen(tmp_path):
    simulation = quiet("iris_rangefinder:1", world_file(tmp_path))
    still = (0.0, 0.0, 0.0)
    simulation.world.place_model(0, Pose((30.0, 0.0, 2.0)), still, still)
    assert distance(simulation, (10.0, 0.0, 5.0)) == pytest.approx(5.0)
    assert distance(simulation, (30.0, 0.0, 5.0)) == pytest.approx(2.9, abs=1e-6)
    box = Box((1.0, 1.0, 1.0))
    simulation.world.add_model(
        7, SdfModel("crate", links=(SdfLink("link", collisions=(Collision(box),)),)), Pose((0.0, 0.0, 0.5))
    )
    assert distance(simulation, (0.0, 0.0, 5.0)) == pytest.approx(4.0, abs=1e-6)
    simulation.world.remove_model(0)
    assert distance(simulation, (30.0, 0.0, 5.0)) == pytest.approx(5.0)
    simulation.close()


def test_without_models_nothing_changes_and_without_a_sensor_nothing_is_built(tmp_path):
    blank = quiet("iris_rangefinder:1", "empty")
    q = from_euler(0.1, 0.2, 0.0)
    assert distance(blank, (3.0, 4.0, 5.0), q) == 5.0 / (1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]))
    blank.close()
    blind = quiet("iris:1", world_file(tmp_path))
    assert [len(array) for array in blind.sensors.below.arrays[:4]] == [0, 0, 0, 0]
    blind.close()


def nearest_triangle(corners, origin, direction) -> float:
    """Return the distance to triangles (k, 3, 3) along a ray (T. Moeller, B. Trumbore, J. Graphics Tools 2, 1997)."""
    a, b, c = corners.transpose(1, 0, 2)
    p = np.cross(direction, c - a)
    det = np.einsum("ij,ij->i", b - a, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("ij,ij->i", origin - a, p) / det
        q = np.cross(origin - a, b - a)
        v = q @ direction / det
        t = np.einsum("ij,ij->i", c - a, q) / det
    return float(t[(u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0)].min())


def test_another_vehicle_below_is_seen_and_one_s_own_body_is_not():
    """A vehicle without URDF counts as a box of the size of its collision box."""
    simulation = quiet("iris_rangefinder:1,px4_reference:1", "empty")
    assert simulation.models[1].urdf.text == ""
    plant, height = simulation.world.plant, simulation.world.models["box"][1][2]
    plant["position"][1] = 4.0, 3.0, 2.0
    assert distance(simulation, (4.0, 3.0, 5.0)) == pytest.approx(3.0 - 0.5 * height, abs=1e-9)
    assert distance(simulation, (4.0, 3.0, 1.0)) == pytest.approx(1.0)  # it is above
    assert distance(simulation, (4.0, 4.0, 5.0)) == pytest.approx(5.0)  # beside
    plant["q"][1] = from_euler(0.0, 0.4, 0.0)
    assert distance(simulation, (4.0, 3.0, 5.0)) == pytest.approx(3.0 - 0.5 * height / math.cos(0.4), abs=1e-9)
    simulation.remove_vehicle(1)
    assert distance(simulation, (4.0, 3.0, 5.0)) == pytest.approx(5.0)
    simulation.close()


def test_the_flow_camera_sees_the_motion_relative_to_what_is_below():
    simulation = quiet("iris_opt_flow:1,px4_reference:1", "empty")
    simulation.world.models["flow_noise"] = 0.0
    plant, height = simulation.world.plant, simulation.world.models["box"][1][2]
    plant["position"][1], plant["velocity"][1] = (4.0, 3.0, 2.0), (0.5, 0.2, 0.0)
    plant["velocity"][0] = 1.5, 0.0, 0.0
    far = distance(simulation, (4.0, 3.0, 5.0))
    flow = simulation.autopilot.sensors["flow_rate"][0]
    assert far == pytest.approx(3.0 - 0.5 * height)
    assert flow == pytest.approx([-0.2 / far, 1.0 / far])
    distance(simulation, (9.0, 3.0, 5.0))
    assert simulation.autopilot.sensors["flow_rate"][0] == pytest.approx([0.0, 1.5 / 5.0])
    simulation.close()


PEOPLE = """<sdf version="1.6"><world name="w">
<actor name="walker"><pose>0 0 0 0 0 0</pose><skin><filename>walk.dae</filename></skin>
<script><loop>false</loop><auto_start>true</auto_start><trajectory id="0" type="walking">
<waypoint><time>0</time><pose>0 0 0 0 0 0</pose></waypoint>
<waypoint><time>10</time><pose>10 0 0 0 0 0</pose></waypoint></trajectory></script></actor>
</world></sdf>"""


def test_a_walking_person_below_is_seen(tmp_path):
    path = tmp_path / "people.world"
    path.write_text(PEOPLE)
    simulation = quiet("iris_rangefinder:1", str(path))
    v = simulation.world.plant[0]
    (skin,) = people_meshes.skins([""])
    body = people_meshes.read(skin)
    for time_us in (1_000_000, 2_320_000):
        ((_, state),) = simulation.actors.present(time_us)
        assert state.position == pytest.approx((time_us * 1e-6, 0.0, 0.0))
        k = 1 + round(state.phase * (len(body.poses) - 1)) % (len(body.poses) - 1)
        head = body.posture(k)[np.argmax(body.posture(k)[:, 2])] - (0.01, 0.0, 0.0)
        v["position"] = np.array(state.position) + np.array([head[0], head[1], 5.0])
        simulation.sensors.sample(0, time_us)
        seen = float(simulation.autopilot.sensors["range_distance"][0])
        corners = body.posture(k)[body.triangles] + state.position
        assert seen == pytest.approx(nearest_triangle(corners, v["position"], np.array([0.0, 0.0, -1.0])), abs=1e-6)
        assert 5.0 - seen > 1.5
        v["position"][:2] += 3.0
        simulation.sensors.sample(0, time_us)
        assert simulation.autopilot.sensors["range_distance"][0] == pytest.approx(5.0)
    simulation.actors.remove(0)
    v["position"][:2] -= 3.0
    simulation.sensors.sample(0, time_us)
    assert simulation.autopilot.sensors["range_distance"][0] == pytest.approx(5.0)
    simulation.close()


def test_many_steps_at_once_are_those_one_by_one():
    """A vehicle falls past one with a downward sensor, which flies in compiled steps or not."""

    def flown(steps: int) -> tuple[bytes, list[float]]:
        simulation = Simulation(parse_fleet("iris_rangefinder:2"), seed=3)
        plant = simulation.world.plant
        plant["position"] = (0.0, 0.0, 60.0), (3.0, 0.0, 50.0)
        plant["velocity"][1] = -3.0, 0.0, 6.0  # below the first one after a second
        plant["contact"] = 0
        seen = []
        while simulation.time_us < 1_600_000:
            if steps == 1:
                simulation.step()
            else:
                simulation.run_until(simulation.time_us + steps * 4000)
            seen.append(float(simulation.autopilot.sensors["range_distance"][0]))
        state = plant.tobytes() + simulation.autopilot.sensors.tobytes()
        simulation.close()
        return state, seen

    (one, seen), (other, again) = flown(1), flown(50)
    assert one == other
    assert seen[49::50] == again
    assert min(seen) < 15.0 < max(seen)  # it measured the other vehicle, and not only the ground


def test_the_autopilot_knows_the_table_below_it_and_lands_on_it(tmp_path):
    flight = Flight("iris_rangefinder", world=world_file(tmp_path))
    flight.take_off(4.0)
    flight.hold()
    height = float(flight.e["position"][2])
    assert flight.e["terrain"] == pytest.approx(0.0, abs=0.15)
    for step in range(1, 21):
        flight.setpoint = (0.0, 0.5 * step, height), UNSET, UNSET, math.nan, 0.0
        flight.run(0.5)
    flight.run(3.0)
    assert flight.e["terrain_valid"]
    assert flight.e["terrain"] == pytest.approx(-1.1, abs=0.2)
    assert -flight.position[2] == pytest.approx(-height, abs=0.3)
    flight.setpoint = None
    assert flight.commander.request(modes.AUTO_LAND) == 0
    flight.run(10.0)
    assert not flight.commander.armed
    assert -flight.position[2] == pytest.approx(1.1 + 0.055, abs=0.01)
    flight.simulation.close()
