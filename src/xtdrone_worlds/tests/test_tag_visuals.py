"""Plates with AprilTags: the family's patterns, drawn without gaps and overlaps, and detected in pictures."""

from __future__ import annotations

import math

import numpy as np
import pytest

from xtdrone_common.poses import Pose
from xtdrone_common.settings import SettingError
from xtdrone_common.tag_boards import LANDING, Tag, TagBoard
from xtdrone_worlds.data_files import data_path
from xtdrone_worlds.worlds.robots.tag_visuals import BLACK, cells_of, model, plate
from xtdrone_worlds.worlds.sdf import read_world
from xtdrone_worlds.worlds.sdf.world_writer import write_model

# The first codes of the family, row by row with white as 1 (tag36h11.c of the AprilTag library, University of Michigan)
CODES = (0xD5D628584, 0xD97F18B49, 0xDD280910E, 0xE479E9C98)


@pytest.mark.parametrize("number", range(len(CODES)))
def test_the_patterns_are_those_of_the_family(number: int) -> None:
    black = cells_of(number)
    assert black[0].all()
    assert black[-1].all()
    assert black[:, 0].all()
    assert black[:, -1].all()
    bits = "".join("0" if cell else "1" for cell in black[1:-1, 1:-1].ravel())
    assert int(bits, 2) == CODES[number]


def test_black_and_white_cover_the_plate_once() -> None:
    visuals = plate(LANDING, 1.4, 1.4, 0.04, Pose((0.0, 0.0, 0.5)))
    areas = {True: 0.0, False: 0.0}
    covered = np.zeros((700, 700), int)  # 2 mm
    for visual in visuals:
        length, width, thickness = visual.geometry.size
        assert thickness == 0.04
        assert visual.pose.position[2] == pytest.approx(0.48)
        areas[visual.colour == BLACK] += length * width
        x, y = visual.pose.position[0] + 0.7, visual.pose.position[1] + 0.7
        rows = slice(round((y - 0.5 * width) * 500), round((y + 0.5 * width) * 500))
        covered[rows, round((x - 0.5 * length) * 500) : round((x + 0.5 * length) * 500)] += 1
    assert covered.min() == covered.max() == 1
    assert areas[True] == pytest.approx(sum(cells_of(tag.id).sum() * (tag.size / 8) ** 2 for tag in LANDING.tags))
    assert areas[True] + areas[False] == pytest.approx(1.96)


MODELS = {
    "landing_board": (LANDING, 1.4),
    **{f"apriltag{k}": (TagBoard(f"tag_{k}", (Tag(k, 0.5),)), 0.625) for k in range(3)},  # XTDrone's names and size
}


def model_text(name: str) -> str:
    board, edge = MODELS[name]
    return write_model(model(name, board, edge, edge))


@pytest.mark.parametrize("name", MODELS)
def test_the_shipped_models_are_these_boards(name: str) -> None:
    """Run as a program, this file writes the models."""
    assert (data_path("models") / name / "model.sdf").read_text(encoding="utf-8") == model_text(name)
    world = f"<sdf version='1.6'><world name='w'><include><uri>model://{name}</uri></include></world></sdf>"
    [there] = read_world(world, data_path("models") / "w.world").models
    assert there.static
    assert len(there.links[0].visuals) > 20


def test_tags_without_room_are_refused() -> None:
    with pytest.raises(SettingError, match=r"tag 3: 1\.2 is not allowed, on 1\.4 x 1\.4 m with a white margin"):
        plate(TagBoard("b", (Tag(3, 1.2),)), 1.4, 1.4, 0.04, Pose())
    with pytest.raises(SettingError, match=r"tag 1: 0\.3 is not allowed, apart from tag 2"):
        plate(TagBoard("b", (Tag(1, 0.3), Tag(2, 0.3, 0.3))), 1.4, 1.4, 0.04, Pose())
    board = TagBoard("b", (Tag(1, 0.2), Tag(2, 0.2, 0.3)))
    assert math.isclose(
        max(v.pose.position[0] + v.geometry.size[0] / 2 for v in plate(board, 1.0, 1.0, 0.1, Pose())), 0.5
    )


if __name__ == "__main__":
    for shipped in MODELS:
        (data_path("models") / shipped).mkdir(exist_ok=True)
        (data_path("models") / shipped / "model.sdf").write_text(model_text(shipped), encoding="utf-8")
