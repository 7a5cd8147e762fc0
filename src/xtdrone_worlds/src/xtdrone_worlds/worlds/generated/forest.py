"""Forest: trees as Poisson discs, at random places that keep a minimum distance from each other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from xtdrone_common.poses import Pose
from xtdrone_common.settings import Settings, setting
from xtdrone_worlds.shapes.visual import Cylinder, Visual
from xtdrone_worlds.worlds.scenery import scenery_objects
from xtdrone_worlds.worlds.scenery.materials import Kit
from xtdrone_worlds.worlds.scenery.scenery_objects import Thing
from xtdrone_worlds.worlds.scenery.start_area_and_ground import START, ground, place, solid, world
from xtdrone_worlds.worlds.sdf import SdfModel, SdfWorld

_TRIES = 30  # candidates around each tree (R. Bridson, "Fast Poisson disk sampling in arbitrary dimensions", 2007)
_FILLED = 0.635  # trees per square of the minimum distance that the sampling reaches, measured
_HIGHEST = 9.0  # m


@dataclass(frozen=True)
class ForestSettings(Settings):
    """Options of a forest."""

    seed: int = setting(0, low=0, text="seed of all random choices")
    density: float = setting(0.04, low=0.001, high=0.5, unit="1/m²", text="trees per square metre")
    length: float = setting(70.0, low=25.0, high=400.0, unit="m", text="along x, from 10 m behind the start area on")
    width: float = setting(60.0, low=25.0, high=400.0, unit="m", text="along y, around the start area")
    trunks: bool = setting(False, text="bare trunks without crowns, as obstacles of planners' tests")


def least_distance(density: float) -> float:
    """Return the minimum distance of two trunks, m, at which sampling fills an area with ``density``, 1/m^2."""
    return math.sqrt(_FILLED / density)


def places(rng: np.random.Generator, x0: float, y0: float, x1: float, y1: float, apart: float) -> np.ndarray:
    """Return random places (n, 2), m, in a rectangle, at least ``apart`` from each other, without room for more.

    Bridson's method: each accepted place proposes candidates in the ring from ``apart`` to twice that around it, and a
    grid with one place a cell finds neighbours.
    """
    cell = apart / math.sqrt(2.0)
    rows, columns = math.ceil((x1 - x0) / cell), math.ceil((y1 - y0) / cell)
    grid = np.full((rows + 4, columns + 4, 2), np.inf)  # with a margin of two cells
    found: list[tuple[float, float]] = []

    def accept(x: float, y: float) -> None:
        grid[int((x - x0) / cell) + 2, int((y - y0) / cell) + 2] = x, y
        found.append((x, y))

    accept(float(rng.uniform(x0, x1)), float(rng.uniform(y0, y1)))
    active = [0]
    while active:
        at = int(rng.integers(len(active)))
        x, y = found[active[at]]
        for _ in range(_TRIES):
            reach, angle = apart * math.sqrt(float(rng.uniform(1.0, 4.0))), float(rng.uniform(-math.pi, math.pi))
            a, b = x + reach * math.cos(angle), y + reach * math.sin(angle)
            if not (x0 <= a < x1 and y0 <= b < y1):
                continue
            i, j = int((a - x0) / cell) + 2, int((b - y0) / cell) + 2
            near = grid[i - 2 : i + 3, j - 2 : j + 3].reshape(-1, 2)
            if (np.hypot(near[:, 0] - a, near[:, 1] - b) >= apart).all():
                active.append(len(found))
                accept(a, b)
                break
        else:
            active.pop(at)
    return np.round(np.array(found), 3)


def forest(settings: ForestSettings) -> SdfWorld:
    """Generate the forest of a seed; no trunk is within 1.5 m of the start area."""
    rng = np.random.default_rng((settings.seed, 30))
    kit = Kit("all", np.random.default_rng((settings.seed, 31)))
    x0, y0 = START[0] - 10.0, 0.5 * (START[1] + START[3] - settings.width)
    region = (x0, y0, x0 + settings.length, y0 + settings.width)
    models = [ground("meadow", region)]
    trunks = places(rng, *region, least_distance(settings.density))
    outside = np.hypot(
        np.maximum.reduce([START[0] - trunks[:, 0], trunks[:, 0] - START[2], np.zeros(len(trunks))]),
        np.maximum.reduce([START[1] - trunks[:, 1], trunks[:, 1] - START[3], np.zeros(len(trunks))]),
    )
    for number, (x, y) in enumerate(trunks[outside >= 1.5].tolist()):
        models.append(_tree(kit, number, x, y, settings))
    return world(f"forest_{settings.seed}", models)


def _tree(kit: Kit, number: int, x: float, y: float, settings: ForestSettings) -> SdfModel:
    if settings.trunks:
        radius, height = kit.uniform(0.12, 0.3), kit.uniform(4.0, _HIGHEST)
        trunk = Visual(Cylinder(radius, height), Pose((x, y, round(0.5 * height, 4))), kit.brown())
        return solid(f"tree_{number}", [trunk])
    thing: Thing = scenery_objects.conifer(kit) if kit.rng.uniform() < 0.5 else scenery_objects.leafy_tree(kit)
    return place(f"tree_{number}", thing, x, y, kit.uniform(-math.pi, math.pi))
