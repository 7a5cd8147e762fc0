"""Contacts, hand-over between the kernel and Bullet, and bad descriptions."""

from __future__ import annotations

import numpy as np
import pytest

from xtdrone_common.fleet import StartPose
from xtdrone_sim.physics.vehicle_dynamics import ASLEEP, FREE, TOUCHING
from xtdrone_sim.physics.world import World
from xtdrone_sim.vehicles.vehicle_model import load_vehicle
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.worlds.catalogue import load_world

DT = 0.004


def make(places):
    return World(load_world("empty"), [load_vehicle("iris")] * len(places), [StartPose(*place) for place in places], DT)


def run(world, steps, command=0.0, armed=0):
    count = len(world.plant)
    for _ in range(steps):
        world.step(np.full((count, 8), command), np.full(count, armed, np.int32))


def test_rests_on_its_belly_and_falls_asleep():
    world = make([(0.0, 0.0, 0.0)])
    run(world, 250)
    assert world.plant["contact"][0] == ASLEEP
    assert world.plant["position"][0, 2] == pytest.approx(0.055, abs=2e-3)


def test_falls_through_the_air_and_stops_on_the_ground():
    world = make([(0.0, 0.0, 5.0)])
    run(world, 10)
    assert world.plant["contact"][0] == FREE
    run(world, 600)
    assert world.plant["position"][0, 2] == pytest.approx(0.055, abs=5e-3)
    assert world.plant["contact"][0] == ASLEEP


def test_bullet_and_kernel_agree_on_the_same_wrench():
    """Both integrators move the same spinning, falling, thrusting body alike for 0.2 s."""
    states = []
    for contact in (FREE, TOUCHING):
        world = make([(0.0, 0.0, 50.0)])
        v = world.plant
        v["rates"][0] = (1.0, -0.5, 2.0)
        v["velocity"][0] = (1.0, 2.0, 3.0)
        v["q"][0] = (0.8, 0.6, 0.0, 0.0)
        v["rotor_speed"][0, :4] = (600.0, 700.0, 650.0, 640.0)
        v["contact"] = contact
        if contact == TOUCHING:
            world._hand_over(0)
        world._touching = [0] if contact == TOUCHING else []
        world._sort_contacts = lambda armed: None  # keep the integrator under test
        run(world, 50, 0.55, armed=1)
        states.append(world.plant.copy())
    free, bullet = states
    np.testing.assert_allclose(bullet["position"], free["position"], atol=0.02)
    np.testing.assert_allclose(bullet["velocity"], free["velocity"], atol=0.05)
    np.testing.assert_allclose(bullet["rates"], free["rates"], atol=0.05)
    np.testing.assert_allclose(bullet["q"], free["q"], atol=0.01)


def test_vehicles_collide_and_the_collision_is_noted():
    world = make([(0.0, 0.0, 3.0), (0.0, 0.0, 1.0)])
    world.plant["velocity"][0, 2] = -8.0
    run(world, 400)
    assert world.collisions == {(0, 1)}


def test_a_falling_vehicle_wakes_the_one_below():
    world = make([(0.0, 0.0, 0.0), (0.1, 0.0, 6.0)])
    run(world, 200)
    assert world.plant["contact"][0] == ASLEEP
    run(world, 200)
    assert (0, 1) in world.collisions


def test_far_vehicles_do_not_influence_each_other():
    alone, pair = make([(0.0, 0.0, 0.0)]), make([(0.0, 0.0, 0.0), (50.0, 0.0, 0.0)])
    run(alone, 500, 0.6, armed=1)
    run(pair, 500, 0.6, armed=1)
    np.testing.assert_array_equal(alone.plant["position"][0], pair.plant["position"][0])


def test_unknown_world_lists_the_known():
    with pytest.raises(ModelError, match="empty"):
        load_world("mars")


def test_a_missing_world_file_is_reported():
    with pytest.raises(ModelError, match=r"no/such/file\.yaml: No such file"):
        load_world("no/such/file.yaml")


def test_unknown_vehicle_lists_the_known():
    with pytest.raises(ModelError, match="iris"):
        load_vehicle("hovercraft")


def test_bad_vehicle_file(tmp_path):
    path = tmp_path / "half.yaml"
    path.write_text("mass: -1\n")
    with pytest.raises(ModelError, match="mass: -1"):
        load_vehicle(str(path))
