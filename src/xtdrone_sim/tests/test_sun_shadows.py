"""Shadows of the sun in pictures: position in closed form, darkness, and options that disable them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.poses import Pose
from xtdrone_common.rotation import from_euler
from xtdrone_sim.cameras.drawn_scene import DrawnScene, View
from xtdrone_sim.cameras.rendering import Renderer, RendererError
from xtdrone_sim.rays.scene import SceneAt
from xtdrone_worlds.shapes.visual import Box, Collision, Visual
from xtdrone_worlds.worlds.catalogue import load_world
from xtdrone_worlds.worlds.sdf import Light, SdfLink, SdfModel, read_world, world_file

EYE = "eye::link"
ABOVE = SceneAt({EYE: Pose((0.0, 0.0, 30.0), from_euler(0.0, 0.5 * math.pi, 0.0))}, {})  # north is to the left
VIEW = View(EYE, Pinhole.of_view(240, 240, 1.0), 0.05, 500.0)
LIGHT = Light(direction=(1.0, 0.0, -1.0), diffuse=(0.6, 0.6, 0.6), ambient=(0.2, 0.3, 0.4))


@pytest.fixture(params=["tiny", "egl"])
def renderer(request: pytest.FixtureRequest) -> Any:
    try:
        made = Renderer(request.param)
    except RendererError as error:
        pytest.skip(str(error))
    with made:
        yield made


def world_of(light: Light) -> Any:
    """Return a world with a box of 2 x 2 m on stilts, 3 to 4 m above level ground."""
    box = Box((2.0, 2.0, 1.0))
    link = SdfLink("link", visuals=(Visual(box, colour=(1.0, 0.0, 0.0, 1.0)),), collisions=(Collision(box),))
    roof = SdfModel("roof", Pose((-3.0, 0.0, 3.5)), links=(link,))
    return replace(load_world("empty"), light=light, models=(roof,))


def test_a_shadow_lies_where_the_sun_does_not_reach(renderer: Renderer) -> None:
    world = world_of(LIGHT)
    dark = DrawnScene(renderer, world, shadows=True).draw(ABOVE, VIEW)
    assert dark.depth is None
    with_depth = DrawnScene(renderer, world, shadows=True).draw(ABOVE, replace(VIEW, depth=True))
    assert with_depth.depth is not None
    plain = DrawnScene(renderer, world).draw(ABOVE, VIEW).rgb
    rows, columns = np.indices((240, 240))
    x = (120.0 - rows - 0.5) * 30.0 / VIEW.pinhole.fx  # the picture's top is east
    y = (120.0 - columns - 0.5) * 30.0 / VIEW.pinhole.fx
    # Light at 45 degrees projects the box's edges at x = -4, z = 3 and x = -2, z = 4 to x = -1 and x = 2.
    shadow = (np.abs(y) < 1.0) & (x > -1.0) & (x < 2.0)
    unclear = (np.abs(np.abs(y) - 1.0) < 0.3) | (np.abs(x + 1.0) < 0.3) | (np.abs(x - 2.0) < 0.3)
    on_ground = plain[..., 0] < 2 * plain[..., 1].astype(int)
    sure = on_ground & ~unclear
    share = dark.rgb.astype(float) / np.maximum(plain, 1)
    np.testing.assert_allclose(share[shadow & sure].mean(axis=0), (0.2 / 0.8, 0.3 / 0.9, 0.4), atol=0.01)
    assert np.array_equal(dark.rgb[sure & ~shadow], plain[sure & ~shadow])


def test_a_moved_model_takes_its_shadow_along() -> None:
    with Renderer("tiny") as renderer:
        scene = DrawnScene(renderer, world_of(LIGHT), shadows=True)
        before = scene.draw(ABOVE, VIEW).rgb
        moved = SceneAt({**ABOVE.links, "roof::link": Pose((-3.0, 4.0, 3.5))}, {})
        after = scene.draw(moved, VIEW).rgb
        scene.change([], ["roof"])
        gone = scene.draw(ABOVE, VIEW).rgb
    middle, side = (115, 120), (115, 120 - round(4.0 * VIEW.pinhole.fx / 30.0))
    assert before[middle].sum() < 0.5 * after[middle].sum()
    assert after[side].sum() < 0.5 * before[side].sum()
    assert len(np.unique(gone.reshape(-1, 3), axis=0)) == 1


def test_a_light_without_shadows_casts_none() -> None:
    pictures = []
    for light, shadows in ((replace(LIGHT, shadows=False), True), (LIGHT, False)):
        with Renderer("tiny") as renderer:
            pictures.append(DrawnScene(renderer, world_of(light), shadows=shadows).draw(ABOVE, VIEW).rgb)
    assert np.array_equal(*pictures)
    text = """<sdf version="1.6"><world name="w"><light type="directional" name="sun"><cast_shadows>{}</cast_shadows>
    <direction>0 0 -1</direction></light></world></sdf>"""
    for word, expected in (("true", True), ("0", False)):
        assert read_world(text.format(word), world_file("empty")).light.shadows == expected


def test_the_sky_has_its_colour_at_all_distances(renderer: Renderer) -> None:
    for near, far in ((0.05, 500.0), (0.05, 300.0), (0.1, 100.0)):
        picture = renderer.draw(Pinhole.of_view(16, 16, 1.0), Pose(), near, far, LIGHT, depth=True)
        assert picture.depth is not None
        assert np.isinf(picture.depth).all()
        assert (picture.rgb == np.round(255 * np.array(LIGHT.background)).astype(np.uint8)).all()
