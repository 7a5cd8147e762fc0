"""Scenery from a seed: repeatable, without overlaps, people on free ground, nothing shared by the splits."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest

from xtdrone_common.poses import Pose, compose
from xtdrone_common.rotation import from_euler
from xtdrone_worlds.data_files import data_path
from xtdrone_worlds.shapes.visual import Box, Mesh
from xtdrone_worlds.worlds.scenery import FreeGround, is_free, outdoor
from xtdrone_worlds.worlds.scenery import __main__ as program
from xtdrone_worlds.worlds.scenery.scenery_objects import HIGHEST
from xtdrone_worlds.worlds.sdf import SdfWorld, load_world_file, read_world, write_world
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of

CLEAR = (-3.0, -3.0, 18.0, 13.0)


@pytest.fixture(scope="module")
def scene() -> SdfWorld:
    return outdoor(3, persons=4, walking=True, skins=("anna", "bert"))


def test_the_same_seed_repeats_the_world(scene: SdfWorld) -> None:
    assert outdoor(3, persons=4, walking=True, skins=("anna", "bert")) == scene
    assert outdoor(4, persons=4).models != scene.models
    alone = outdoor(3, persons=1)
    assert alone.models == scene.models
    assert alone.actors[0].pose == scene.actors[0].pose  # for every skin and number of people
    assert {actor.skin for actor in scene.actors} == {"anna", "bert"}
    assert read_world(write_world(scene), Path("/x.world")) == scene


def test_the_shipped_world_is_that_of_seed_0() -> None:
    """It surrounds the region that launch/search.launch searches."""
    shipped, made = load_world_file("outdoor"), outdoor(0, region=(10.0, -35.0, 120.0, 35.0), walking=True)
    assert shipped.models == made.models
    assert shipped.actors[0].pose == made.actors[0].pose


@pytest.mark.parametrize("seed", range(3))
def test_nothing_reaches_to_where_vehicles_look_for_people(seed: int) -> None:
    visuals = [
        (link, visual) for model in outdoor(seed, objects=2.0).models for link in model.links for visual in link.visuals
    ]
    tops = [box_of(visual.geometry, compose(link.pose, visual.pose))[1][2] for link, visual in visuals]
    assert max(tops) < HIGHEST + 0.5  # the last twig of a crown


def collision_circles(world: SdfWorld) -> np.ndarray:
    """Return (x, y, radius) of the largest upright circle in each model's collisions' common box."""
    rows = []
    for number, model in enumerate(world.models):
        for link in model.links:
            for collision in link.collisions:
                low, high = box_of(collision.geometry, compose(link.pose, collision.pose))
                rows.append((*model.pose.position[:2], float(min(high[0], high[1], -low[0], -low[1])), number))
    return np.array(rows)


def test_objects_do_not_overlap(scene: SdfWorld) -> None:
    circles = collision_circles(scene)
    apart = np.hypot(*(circles[:, None, :2] - circles[None, :, :2]).transpose(2, 0, 1))
    other = circles[:, None, 3] != circles[None, :, 3]
    assert np.all((apart > circles[:, None, 2] + circles[None, :, 2])[other])
    assert len(set(circles[:, 3])) > 100


def test_the_start_is_free(scene: SdfWorld) -> None:
    ground = FreeGround(scene)
    for x in np.arange(CLEAR[0], CLEAR[2], 1.0):
        for y in np.arange(CLEAR[1], CLEAR[3], 1.0):
            assert ground.is_free(x, y, 0.0)


def test_people_walk_on_free_ground_facing_ahead(scene: SdfWorld) -> None:
    ground = FreeGround(scene)
    for actor in scene.actors:
        assert actor.trajectory is not None
        points = actor.trajectory.waypoints
        assert points[0].pose == points[-1].pose  # a round
        walked = 0.0
        for a, b in itertools.pairwise(points):
            start, end = a.pose.position[:2], b.pose.position[:2]
            assert ground.is_free_way(start, end, 0.45)
            way = math.dist(start, end)
            walked += way
            if way:
                heading = math.atan2(end[1] - start[1], end[0] - start[0])
                half = abs(np.dot(from_euler(0.0, 0.0, heading), a.pose.orientation))
                assert half == pytest.approx(1.0, abs=1e-5)
                assert way / (b.time - a.time) == pytest.approx(actor.speed, rel=0.01)
        assert walked > 5.0
        x, y, z = actor.pose.position
        assert z == 0.0
        assert math.hypot(max(CLEAR[0] - x, 0.0, x - CLEAR[2]), max(CLEAR[1] - y, 0.0, y - CLEAR[3])) >= 10.0


def test_free_ground_against_a_known_world(scene: SdfWorld) -> None:
    house = next(model for model in scene.models if model.name == "house_0")
    x, y, _ = house.pose.position
    assert not is_free(scene, x, y, 0.1)
    walls = house.links[0].collisions[0].geometry
    assert isinstance(walls, Box)
    assert not is_free(scene, x + 0.4 * min(walls.size[:2]), y, 0.0)


def colours_and_files(world: SdfWorld) -> tuple[set[Path], set[Path]]:
    visuals = [visual for model in world.models for link in model.links for visual in link.visuals]
    meshes = {visual.geometry.path for visual in visuals if isinstance(visual.geometry, Mesh)}
    return {visual.texture for visual in visuals if visual.texture}, meshes


def test_train_and_test_scenes_share_neither_textures_nor_forms() -> None:
    found = {}
    for split in ("train", "test"):
        both = [colours_and_files(outdoor(seed, split=split, objects=2.0)) for seed in range(2)]
        found[split] = (set.union(*(a for a, _ in both)), set.union(*(b for _, b in both)))
    # a model used in both splits must be the only one of its kind
    only_one = {"wall", "ground", "road", "gable", "hip", "cone", "triangle"}
    for train, test in zip(found["train"], found["test"], strict=True):
        shared = {path.stem.rpartition("_")[0] for path in train & test}
        assert {name for name in shared if not name.startswith("car_")} <= only_one
        assert len(train - test) > 5
        assert len(test - train) > 5


def test_all_files_are_there(scene: SdfWorld) -> None:
    textures, meshes = colours_and_files(scene)
    for path in (*textures, *meshes):
        assert path.is_file()
        assert path.is_relative_to(data_path("models/scenery"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"persons": -1}, "persons: -1 is not allowed, a whole number from 0 to 100"),
        ({"split": "validation"}, "split: 'validation' is not allowed, all, train or test"),
        ({"light": "night"}, "light: 'night' is not allowed"),
        ({"objects": 9.0}, "objects: 9.0 is not allowed, 0 to 3"),
        ({"region": (0.0, 0.0, 5.0, 50.0)}, "region: its side along x: 5.0 is not allowed, 10 to 2000 m"),
        ({"person_distance": 500.0}, "no free place is 500 m away"),
    ],
)
def test_invalid_values_are_reported(options: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        outdoor(0, **options)


def test_the_program_writes_the_functions_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "my.world"
    monkeypatch.setattr("sys.argv", ["scenery", "--seed", "3", "--persons", "2", "--skins", "anna", "-o", str(out)])
    assert program.main() == 0
    assert load_world_file(str(out)) == outdoor(3, persons=2, skins=["anna"])
    assert "actor_0: anna at " in capsys.readouterr().out
    monkeypatch.setattr("sys.argv", ["scenery", "--persons", "101", "-o", str(out)])
    assert program.main() == 1
    assert "persons: 101 is not allowed" in capsys.readouterr().err


def test_an_object_covers_its_ground_area() -> None:
    low, high = box_of(Box((2.0, 1.0, 1.0)), Pose((5.0, 0.0, 0.5), from_euler(0.0, 0.0, math.pi / 2)))
    assert [*low, *high] == pytest.approx([4.5, -1.0, 0.0, 5.5, 1.0, 1.0])
