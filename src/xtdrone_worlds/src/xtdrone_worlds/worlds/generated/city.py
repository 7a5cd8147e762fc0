"""City: blocks of buildings between streets, with cars, trees and lamps; the start area is an empty square."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from xtdrone_common.poses import Pose
from xtdrone_common.settings import Settings, setting
from xtdrone_worlds.shapes.visual import Box, Colour, Visual
from xtdrone_worlds.worlds.scenery import assets, scenery_objects
from xtdrone_worlds.worlds.scenery.materials import Kit
from xtdrone_worlds.worlds.scenery.start_area_and_ground import (
    START,
    Places,
    Rectangle,
    box,
    ground,
    place,
    solid,
    world,
)
from xtdrone_worlds.worlds.sdf import SdfModel, SdfWorld

_GLASS: Colour = (0.2, 0.27, 0.34, 1.0)
_ASPHALT: Colour = (0.27, 0.27, 0.29, 1.0)
_PAVEMENT: Colour = (0.62, 0.61, 0.6, 1.0)
_WHITE: Colour = (1.0, 1.0, 1.0, 1.0)
_FLOOR = 3.2  # m, height of a floor
_MARGIN = 2.0  # m of pavement around the buildings of a block
_KERB = 0.06  # m, thickness of the pavement; only visible, since the ground is the plane z = 0


@dataclass(frozen=True)
class CitySettings(Settings):
    """Options of a city."""

    seed: int = setting(0, low=0, text="seed of all random choices")
    columns: int = setting(4, low=1, high=20, text="blocks along x")
    rows: int = setting(4, low=1, high=20, text="blocks along y")
    block: float = setting(30.0, low=26.0, high=200.0, unit="m", text="side of a block")
    street: float = setting(10.0, low=4.0, high=40.0, unit="m", text="width of a street")
    height: float = setting(18.0, low=3.0, high=120.0, unit="m", text="height of the highest buildings")
    trees: float = setting(2.0, low=0.0, high=20.0, text="trees for each block")
    cars: float = setting(2.0, low=0.0, high=20.0, text="parked cars for each block")


def city(settings: CitySettings) -> SdfWorld:
    """Generate the city of a seed; the block around the start area is an empty square."""
    kit = Kit("all", np.random.default_rng((settings.seed, 50)))
    step = settings.block + settings.street
    x0 = 0.5 * (START[0] + START[2]) - 0.5 * settings.block - step * ((settings.columns - 1) // 2)
    y0 = 0.5 * (START[1] + START[3]) - 0.5 * settings.block - step * ((settings.rows - 1) // 2)
    end = (x0 + step * settings.columns - settings.street, y0 + step * settings.rows - settings.street)
    sides = (end[0] - x0 + 2.0 * settings.street, end[1] - y0 + 2.0 * settings.street)
    streets = box((*sides, 0.02), (0.5 * (x0 + end[0]), 0.5 * (y0 + end[1]), -0.011), _ASPHALT)
    models = [ground("grass", (x0, y0, *end), 1), solid("streets", [], [streets])]
    square = ((settings.columns - 1) // 2, (settings.rows - 1) // 2)
    for i in range(settings.columns):
        for j in range(settings.rows):
            corner = x0 + i * step, y0 + j * step
            models.append(_pavement(f"pavement_{i}_{j}", *corner, settings.block))
            if (i, j) != square:
                models += _buildings(kit, f"{i}_{j}", *corner, settings)
    models += _along_streets(kit, x0, y0, settings, square)
    return world(f"city_{settings.seed}", models)


def _pavement(name: str, x: float, y: float, side: float) -> SdfModel:
    slab = box((side, side, _KERB), (x + 0.5 * side, y + 0.5 * side, 0.5 * _KERB - 0.05), _PAVEMENT)
    return solid(name, [], [slab])


def _buildings(kit: Kit, name: str, x: float, y: float, settings: CitySettings) -> list[SdfModel]:
    """Return one to four buildings, on the parts of a block."""
    inner = settings.block - 2.0 * _MARGIN
    split_x, split_y = (kit.uniform(0.4, 0.6) * inner if kit.rng.uniform() < 0.75 else inner for _ in range(2))
    models: list[SdfModel] = []
    for a, wide in ((0.0, split_x), (split_x, inner - split_x)):
        for b, deep in ((0.0, split_y), (split_y, inner - split_y)):
            if wide < 6.0 or deep < 6.0:
                continue
            part = (x + _MARGIN + a, y + _MARGIN + b, wide, deep)
            models.append(_building(kit, f"building_{name}_{len(models)}", part, settings.height))
    return models


def _building(kit: Kit, name: str, part: Rectangle, highest: float) -> SdfModel:
    """Return a building on the part (x, y, width, depth), m, with whole floors and bands of windows."""
    x, y, wide, deep = part
    wide, deep = wide - kit.uniform(0.5, 2.0), deep - kit.uniform(0.5, 2.0)
    floors = max(1, round(kit.uniform(0.35, 1.0) * highest / _FLOOR))
    high = floors * _FLOOR
    centre = (x + 0.5 * wide, y + 0.5 * deep)
    colour = kit.hsv((0.02, 0.62), (0.03, 0.3), (0.6, 0.95))
    texture = assets.texture("bricks", 0) if kit.rng.uniform() < 0.3 else assets.texture("wall", 0)
    pose = Pose((round(centre[0], 3), round(centre[1], 3), round(0.5 * high, 3)))
    body = Visual(Box((round(wide, 3), round(deep, 3), round(high, 3))), pose, colour, texture)
    roof = box((wide - 0.6, deep - 0.6, 0.5), (*centre, high + 0.25), kit.grey())
    bands = [box((wide + 0.04, deep + 0.04, 1.3), (*centre, floor * _FLOOR + 1.7), _GLASS) for floor in range(floors)]
    corners = [
        box((0.5, 0.5, high), (centre[0] + sx * 0.5 * wide, centre[1] + sy * 0.5 * deep, 0.5 * high), colour)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return solid(name, [body, roof, *corners], bands)


def _along_streets(kit: Kit, x0: float, y0: float, settings: CitySettings, square: tuple[int, int]) -> list[SdfModel]:
    """Return parked cars at the kerbs, and trees and lamps on the pavements."""
    step, count = settings.block + settings.street, settings.columns * settings.rows
    region = (x0, y0, x0 + step * settings.columns - settings.street, y0 + step * settings.rows - settings.street)
    places = Places(kit.rng, region)
    models: list[SdfModel] = []
    makers = (("car", scenery_objects.car, settings.cars), ("tree", scenery_objects.leafy_tree, settings.trees))
    for kind, make, share in makers:
        for _ in range(round(share * count)):
            thing = make(kit)
            i, j = int(kit.rng.integers(settings.columns)), int(kit.rng.integers(settings.rows))
            away = 1.3 if kind == "car" else -1.0  # m from the kerb, outwards
            along, side = kit.uniform(3.0, settings.block - 3.0), int(kit.rng.integers(4))
            x, y, yaw = _at_kerb(x0 + i * step, y0 + j * step, settings.block, along, side, away)
            if kind == "tree" and (i, j) != square:
                thing = _slender(kit)
            if places.is_free(x, y, 2.6 if kind == "car" else 1.0, 0.5):
                places.occupy(x, y, 2.6 if kind == "car" else 1.0)
                models.append(place(f"{kind}_{len(models)}", thing, x, y, yaw))
    return models


def _slender(kit: Kit) -> scenery_objects.Thing:
    """Return a lamp or post that fits on the pavement beside a building."""
    return scenery_objects.pole(kit) if kit.rng.uniform() < 0.5 else scenery_objects.sign(kit)


def _at_kerb(x: float, y: float, side: float, along: float, which: int, away: float) -> tuple[float, float, float]:
    """Return x, y and yaw beside the kerb of a block: on its south, east, north or west side."""
    return (
        (x + along, y - away, 0.0),
        (x + side + away, y + along, 0.5 * math.pi),
        (x + along, y + side + away, math.pi),
        (x - away, y + along, -0.5 * math.pi),
    )[which]
