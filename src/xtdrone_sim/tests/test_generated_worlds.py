"""Generated worlds: the laws of each kind, names and options, and rejections."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from xtdrone_common.fleet import parse_fleet
from xtdrone_sim.physics.vehicle_dynamics import TOUCHING
from xtdrone_sim.simulation import Simulation
from xtdrone_worlds.descriptions import ModelError
from xtdrone_worlds.shapes.visual import Box
from xtdrone_worlds.worlds.catalogue import KINDS, UPSTREAM, find_world, generate, is_known, known_names, load_world
from xtdrone_worlds.worlds.generated.forest import least_distance, places
from xtdrone_worlds.worlds.generated.indoor import IndoorSettings, floor_plan
from xtdrone_worlds.worlds.generated.maze import passages
from xtdrone_worlds.worlds.sdf import SdfWorld, load_world_file

SEEDS = st.integers(0, 2**31 - 1)


def reached(count: int, links: set[tuple[int, int]]) -> set[int]:
    """Return the numbers below ``count`` that are reachable from 0."""
    seen, active = {0}, [0]
    while active:
        at = active.pop()
        for a, b in links:
            other = {a: b, b: a}.get(at)
            if other is not None and other < count and other not in seen:
                seen.add(other)
                active.append(other)
    return seen


@pytest.mark.parametrize("name", [*KINDS, *UPSTREAM])
def test_a_world_is_the_same_each_time_and_in_its_file(name: str) -> None:
    world = generate(name)
    assert generate(name) == world
    loaded = load_world_file(str(find_world(name)))
    assert (loaded.models, loaded.actors, loaded.light) == (world.models, world.actors, world.light)
    assert loaded == load_world(name)


@pytest.mark.parametrize("kind", KINDS)
def test_seeds_differ(kind: str) -> None:
    assert generate(f"{kind}:seed=1").models != generate(f"{kind}:seed=2").models


@pytest.mark.parametrize("name", [*KINDS, *UPSTREAM])
def test_fifteen_vehicles_start_free(name: str) -> None:
    simulation = Simulation(parse_fleet("iris:9,typhoon_h480:6"), world=name)
    simulation.run_until(40_000)
    assert (simulation.world.plant["contact"] == TOUCHING).all()
    simulation.close()


@settings(deadline=None, max_examples=25)
@given(SEEDS, st.floats(0.5, 8.0))
def test_trees_keep_apart_and_leave_no_gap(seed: int, apart: float) -> None:
    """The trees are maximal Poisson discs: no pair nearer than ``apart``, hardly a point farther from all trees."""
    points = places(np.random.default_rng(seed), 0.0, 0.0, 20.0, 15.0, apart)
    distances = [math.dist(a, b) for a, b in itertools.combinations(points.tolist(), 2)]
    assert min(distances, default=apart) >= apart - 2e-3  # coordinates are rounded to 1 mm
    probes = np.random.default_rng(1).uniform((0.0, 0.0), (20.0, 15.0), (500, 2))
    nearest = np.hypot(*(probes[:, None] - points[None]).transpose(2, 0, 1)).min(axis=1)
    assert np.quantile(nearest, 0.9) < 1.05 * apart


@pytest.mark.parametrize("density", [0.01, 0.05, 0.2])
def test_density_of_trees(density: float) -> None:
    counts = [len(places(np.random.default_rng(k), 0.0, 0.0, 80.0, 80.0, least_distance(density))) for k in range(3)]
    assert np.mean(counts) / 6400.0 == pytest.approx(density, rel=0.1)


@settings(deadline=None, max_examples=40)
@given(SEEDS, st.integers(1, 12), st.integers(1, 12), st.sampled_from([0.0, 0.3]))
def test_mazes_are_connected_and_perfect_without_loops(seed: int, columns: int, rows: int, loops: float) -> None:
    east, north = passages(np.random.default_rng(seed), columns, rows, loops)
    links = {(i * rows + j, (i + 1) * rows + j) for i, j in np.argwhere(east).tolist()}
    links |= {(i * rows + j, i * rows + j + 1) for i, j in np.argwhere(north).tolist()}
    assert len(reached(columns * rows, links)) == columns * rows
    if loops == 0.0:
        assert len(links) == columns * rows - 1  # a tree: exactly one path between any two cells


@settings(deadline=None, max_examples=40)
@given(SEEDS, st.floats(8.0, 80.0), st.floats(7.0, 60.0), st.floats(3.0, 9.0))
def test_every_room_of_a_building_is_reached_by_doors(seed: int, length: float, width: float, room: float) -> None:
    plan = floor_plan(IndoorSettings(seed=seed, length=length, width=width, room=room))
    assert len(reached(len(plan.rooms), plan.links)) == len(plan.rooms)
    area = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in plan.rooms)
    assert area == pytest.approx(length * width, rel=1e-9)
    for (x0, y0), (x1, y1), doors in plan.walls:
        assert (x0 == x1) != (y0 == y1)
        assert all(0.5 <= at <= math.hypot(x1 - x0, y1 - y0) - 0.5 for at in doors)


def test_a_door_is_open_and_has_a_lintel() -> None:
    world = generate("indoor:furniture=0,door=1.2,lintel=2.2,height=3")
    (walls,) = [model for model in world.models if model.name == "walls"]
    boxes = [(shape.pose.position, shape.geometry) for shape in walls.links[0].collisions]
    over = [(place, form) for place, form in boxes if isinstance(form, Box) and form.size[2] == pytest.approx(0.8)]
    entrance = min(over, key=lambda one: one[0][0])
    assert entrance[0] == pytest.approx((20.0, 5.0, 2.6))
    assert entrance[1].size == pytest.approx((0.15, 1.2, 0.8))
    for (x, y, z), form in boxes:
        assert isinstance(form, Box)
        a, b, c = (0.5 * side for side in form.size)
        assert not (abs(x - 20.0) < a and abs(y - 5.0) < b and abs(z - 1.1) < c)


def test_streets_of_a_city_are_free_of_buildings() -> None:
    world = generate("city:columns=3,rows=3,block=30,street=10,seed=4")
    step, corner = 40.0, (7.5 - 15.0 - 40.0, 5.0 - 15.0 - 40.0)
    for model in world.models:
        if model.name.startswith("building"):
            for shape in model.links[0].collisions:
                assert isinstance(shape.geometry, Box)
                for axis in (0, 1):
                    low = (shape.pose.position[axis] - 0.5 * shape.geometry.size[axis] - corner[axis]) % step
                    high = low + shape.geometry.size[axis]
                    assert low >= 1.0
                    assert high <= 29.0


def test_names_options_and_refusals() -> None:
    assert {"empty", "outdoor", "forest", "indoor3", "ego_swarm"} <= set(known_names())
    assert is_known("maze:columns=3")
    assert not is_known("moon")
    walls = [model for model in generate("maze: columns=3, rows=2, height=5").models if model.name == "walls"]
    assert {shape.geometry.size[2] for shape in walls[0].links[0].collisions} == {5.0}  # type: ignore[union-attr]
    refused = {
        "forest:density=2": "world forest density: 2 is not allowed, 0.001 to 0.5 1/m²",
        "forest:density=dense": "world forest density: 'dense' is not allowed",
        "forest:trees=3": "world forest: {'trees': 3} is not allowed, a mapping with seed, density",
        "maze:rows": "world maze: 'rows' is not allowed, OPTION=VALUE",
        "maze:rows=2,rows=3": "world maze: 'rows=3' is not allowed, OPTION=VALUE, each option once",
        "indoor:door=1.9": "door: 1.9 is not allowed, at most 1.7 m",
        "indoor:width=6,corridor=3": "width: 6.0 is not allowed, at least 7 m",
        "city:rows=[": "world city: rows: '\\[' is not a value",
    }
    for name, text in refused.items():
        with pytest.raises(ModelError, match=text.replace("{", "\\{").replace("}", "\\}")):
            load_world(name)


def test_a_generated_world_adds_to_the_surroundings_of_empty() -> None:
    world: SdfWorld = generate("maze")
    empty = load_world_file("empty")
    assert (world.datum, world.gravity, world.wind, world.friction) == (
        empty.datum, empty.gravity, empty.wind, empty.friction,
    )  # fmt: skip
