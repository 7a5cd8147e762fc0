"""Range finder and flow camera of the autopilot over what stands in the world."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from test_estimator_flights import UNSET, Flight

from xtdrone_control.autopilot import modes
from xtdrone_control.fleet import parse_fleet
from xtdrone_control.rotation import from_euler
from xtdrone_sim.simulation import Simulation
from xtdrone_sim.vehicles.visual import Box, Collision, Pose
from xtdrone_sim.worlds.sdf import SdfLink, SdfModel

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
    assert distance(simulation, (10.0, 0.0, 0.5)) == pytest.approx(0.5)  # beneath the table
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
    assert [len(array) for array in blind.sensors.below.arrays] == [0, 0, 0, 0]
    blind.close()


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
