"""Vehicles and obstacles: near enough for Bullet, landed on, and collided with."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.fleet import StartPose
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.physics.bodies.obstacles import Obstacles
from xtdrone_sim.physics.vehicle_dynamics import ASLEEP, FREE, PLANT, TOUCHING
from xtdrone_sim.physics.world import World
from xtdrone_sim.vehicles.vehicle_model import MODEL, load_vehicle
from xtdrone_worlds.shapes.visual import Box, Collision, Cylinder, Geometry, Mesh, Sphere
from xtdrone_worlds.worlds.catalogue import load_world
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel

DT = 0.004


def model(name: str, geometry: Geometry, position: tuple[float, float, float], yaw: float = 0.0) -> SdfModel:
    shape = Collision(geometry, Pose((0.0, 0.0, 0.0), from_euler(0.0, 0.0, yaw)))
    return SdfModel(name, Pose(position), True, (SdfLink("link", collisions=(shape,)),))


def make(models: tuple[SdfModel, ...], places: list[tuple[float, float, float]]) -> World:
    return World(
        replace(load_world("empty"), models=models),
        [load_vehicle("iris")] * len(places),
        [StartPose(*place) for place in places],
        DT,
    )


def run(world: World, steps: int) -> None:
    count = len(world.plant)
    for _ in range(steps):
        world.step(np.zeros((count, 8)), np.zeros(count, np.int32))


def test_a_vehicle_lands_on_a_house_and_sleeps_there():
    world = make((model("house", Box((6.0, 8.0, 4.0)), (20.0, 0.0, 2.0), 0.5),), [(20.0, 0.0, 6.0), (0.0, 0.0, 0.0)])
    run(world, 3)
    assert world.plant["contact"][0] == FREE
    run(world, 600)
    assert world.plant["position"][0, 2] == pytest.approx(4.055, abs=5e-3)
    assert world.plant["contact"].tolist() == [ASLEEP, ASLEEP]
    assert world.collisions == {(0, 2)}
    world.close()


def test_a_vehicle_stops_at_a_wall_and_falls_down():
    tree = model("tree", Cylinder(1.0, 2.0), (9.0, 9.0, 1.0))
    world = make((tree, model("wall", Box((0.3, 10.0, 8.0)), (5.0, 0.0, 4.0))), [(0.0, 0.0, 6.0)])
    world.plant["velocity"][0] = (10.0, 0.0, 2.0)
    furthest = 0.0
    for _ in range(700):
        run(world, 1)
        furthest = max(furthest, float(world.plant["position"][0, 0]))
    iris = load_vehicle("iris").record
    assert 5.0 - 0.15 - float(iris["radius"]) < furthest < 5.0 - 0.15 - 0.4 * float(iris["box"].min())
    assert world.plant["position"][0, 2] < 0.5
    assert world.plant["position"][0, 0] < 5.0
    assert world.collisions == {(0, 2)}
    world.close()


@pytest.mark.parametrize("speed", [0.0, 5.0])
def test_only_vehicles_that_come_near_are_near(speed):
    """The list equals that by the distance to all boxes, for random boxes and positions."""
    rng = np.random.default_rng(4)
    sizes = rng.uniform(0.2, 12.0, (60, 3))
    middles = rng.uniform(-60.0, 60.0, (60, 3))
    obstacles = Obstacles(
        {k: model(f"m{k}", Box(tuple(sizes[k])), tuple(middles[k])) for k in range(60)}  # type: ignore[arg-type]
    )
    count = 3000
    plant, models = np.zeros(count, PLANT), np.zeros(count, MODEL)
    plant["position"] = rng.uniform(-70.0, 70.0, (count, 3))
    plant["velocity"][:, 0] = speed
    plant["contact"] = np.where(rng.uniform(size=count) < 0.5, FREE, TOUCHING)
    models["radius"] = rng.uniform(0.1, 1.5, count)
    limits, horizon = np.array([0.25, 0.4]), 0.02
    apart = np.maximum(np.abs(plant["position"][:, None] - middles[None]) - 0.5 * sizes[None], 0.0)
    least = np.linalg.norm(apart, axis=2).min(axis=1)
    reach = models["radius"] + speed * horizon + np.where(plant["contact"] == FREE, *limits)
    wanted = np.full(count, FREE)
    found = obstacles.mark_near(plant, models, limits, horizon, wanted)
    np.testing.assert_array_equal(wanted == TOUCHING, least < reach)
    assert found == np.count_nonzero(least < reach) > 20


def test_lost_vehicles_are_near_nothing():
    obstacles = Obstacles({0: model("ball", Sphere(2.0), (0.0, 0.0, 1.0))})
    plant, models, wanted = np.zeros(4, PLANT), np.zeros(4, MODEL), np.full(4, FREE)
    plant["position"] = [(math.nan, 0.0, 0.0), (math.inf, 0.0, 0.0), (1e300, -1e300, 0.0), (0.0, 0.0, 0.0)]
    assert obstacles.mark_near(plant, models, np.array([0.25, 0.4]), 0.02, wanted) == 1
    assert wanted.tolist() == [FREE, FREE, FREE, TOUCHING]


def test_a_mesh_keeps_its_hollow(tmp_path: Path):
    """A vehicle falls into an open trough and rests on its bottom, 1 m up, not on its rim."""
    path = tmp_path / "trough.obj"
    points = [(x, y, z) for x, z in ((-4, 3), (-2, 1), (2, 1), (4, 3)) for y in (-3, 3)]
    faces = [f"f {k + 1} {k + 2} {k + 4}\nf {k + 1} {k + 4} {k + 3}" for k in (0, 2, 4)]
    path.write_text("\n".join([f"v {x} {y} {z}" for x, y, z in points] + faces) + "\n")
    world = make((model("trough", Mesh(path), (0.0, 0.0, 0.0)),), [(0.0, 0.0, 4.0)])
    run(world, 700)
    assert world.plant["position"][0, 2] == pytest.approx(1.055, abs=0.02)
    assert world.collisions == {(0, 1)}
    world.close()
