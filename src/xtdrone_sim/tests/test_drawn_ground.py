"""The ground below a world's models, as cameras see it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.cameras.drawn_scene import DrawnScene, SceneAt, View, ground_level
from xtdrone_sim.cameras.rendering import Renderer
from xtdrone_worlds.shapes.visual import Box, Geometry, Visual
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel, load_world_file

EYE = "camera::link"


def model(name: str, shape: Geometry, z: float) -> SdfModel:
    return SdfModel(name, Pose((4.0, 0.0, z)), links=(SdfLink("link", visuals=(Visual(shape, colour=(1, 0, 0, 1)),)),))


WALL = model("wall", Box((0.2, 2.0, 1.0)), 0.5)
ROAD = model("road", Box((40.0, 3.0, 0.001)), 0.0)
FIELD = model("field", Box((150.0, 120.0, 1.0)), -0.6)


@pytest.mark.parametrize(
    ("models", "level"),
    [
        ((), 0.0),
        ((WALL,), 0.0),
        ((WALL, ROAD), -0.12),
        ((ROAD, FIELD), None),
        ((model("roof", Box((200, 200, 1)), 9),), 0.0),
    ],
)
def test_the_ground_is_below_all_models_unless_one_is_ground(models: tuple[SdfModel, ...], level: float | None) -> None:
    assert ground_level(models) == level


def test_pictures_of_a_world_with_a_wall_have_ground_up_to_the_horizon() -> None:
    empty = load_world_file("empty")
    view = View(EYE, Pinhole.of_view(80, 60, 1.2), 0.05, 500.0)
    scene = SceneAt({EYE: Pose((-4.0, 0.0, 1.5), from_euler(0.0, 0.1, 0.0))}, {})
    pictures = []
    for models in ((), (WALL,)):
        with Renderer("tiny") as renderer:
            pictures.append(DrawnScene(renderer, replace(empty, models=models)).draw(scene, view).rgb.copy())
    other = np.any(pictures[0] != pictures[1], axis=2)
    assert 20 < other.sum() < 400  # the wall alone
    assert not other[:, :20].any()
    assert (pictures[1][-1] == pictures[0][-1]).all()
