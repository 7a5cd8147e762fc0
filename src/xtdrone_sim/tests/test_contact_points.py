"""Contact points of vehicles: forces against the weight, touched objects, and none in flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from xtdrone_common import modes
from xtdrone_common.fleet import StartPose, parse_fleet
from xtdrone_sim.physics.contacts.bullet_contacts import GROUND
from xtdrone_sim.simulation import Simulation


def test_a_standing_vehicle_is_carried_by_the_ground() -> None:
    simulation = Simulation(parse_fleet("iris:1"))
    simulation.run_until(400_000)
    weight = float(simulation.models[0].record["mass"]) * simulation.world.model.gravity
    contacts = simulation.world.contacts(0)
    assert {one.other for one in contacts} == {GROUND}
    assert sum(one.force[2] for one in contacts) == pytest.approx(weight, rel=0.02)
    for one in contacts:
        assert one.normal == pytest.approx([0.0, 0.0, 1.0], abs=1e-3)
        assert one.position[2] == pytest.approx(0.0, abs=2e-3)
        assert 0.0 <= one.depth < 5e-3
    simulation.run_until(2_000_000)  # asleep
    assert {one.other for one in simulation.world.contacts(0)} == {GROUND}
    simulation.close()


def test_a_vehicle_on_another_pushes_it_down_and_is_pushed_up() -> None:
    simulation = Simulation(parse_fleet("iris:2"), places=[(0.0, 0.0, 0.0), (0.0, 0.0, 0.12)])
    simulation.run_until(300_000)
    weight = float(simulation.models[0].record["mass"]) * simulation.world.model.gravity
    (lower,) = {one.other for one in simulation.world.contacts(0)} - {GROUND}
    upper = simulation.world.contacts(1)
    assert lower == 1
    assert {one.other for one in upper} == {0}
    assert sum(one.force[2] for one in upper) == pytest.approx(weight, rel=0.1)
    below = np.sum([one.force for one in simulation.world.contacts(0) if one.other == 1], axis=0)
    assert below[2] == pytest.approx(-weight, rel=0.1)
    simulation.close()


def test_a_vehicle_in_flight_touches_nothing_and_a_wall_when_it_meets_one() -> None:
    simulation = Simulation(parse_fleet("iris:1"), world="maze:columns=1,rows=1,cell=6", places=[(16.0, 5.0, 0.0)])
    simulation.run_until(2_000_000)
    commander = simulation.commanders[0]
    assert commander.request(modes.AUTO_TAKEOFF) == 0
    assert commander.arm_disarm(True) == 0
    simulation.run_until(12_000_000)
    assert simulation.world.contacts(0) == []
    q = (1.0, 0.0, 0.0, 0.0)
    simulation.world.place_vehicle(0, (23.0, 7.4, 1.5), q, (0.0, 3.0, 0.0), (0.0, 0.0, 0.0))
    touched: set[int] = set()
    for _ in range(50):
        simulation.step()
        touched |= {one.other for one in simulation.world.contacts(0)}
    walls = [number for number, model in enumerate(simulation.world.model.models) if model.name == "walls"]
    assert touched == {1 + walls[0]}
    simulation.close()


def test_start_poses_are_kept_apart_from_contacts() -> None:
    """Two vehicles that start 1 m apart touch the ground only."""
    fleet = parse_fleet("iris:2")
    fleet = tuple(replace(one, pose=StartPose(float(k), 0.0)) for k, one in enumerate(fleet))
    simulation = Simulation(fleet)
    simulation.run_until(400_000)
    assert [{one.other for one in simulation.world.contacts(i)} for i in (0, 1)] == [{GROUND}, {GROUND}]
    simulation.close()
