"""Common parts of the world generators: the start area, ground, boxes, and free places."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose, compose
from xtdrone_common.rotation import from_euler
from xtdrone_worlds.shapes.visual import Box, Collision, Colour, Mesh, Visual
from xtdrone_worlds.worlds.scenery import assets
from xtdrone_worlds.worlds.scenery.scenery_objects import Thing
from xtdrone_worlds.worlds.sdf import Light, SdfLink, SdfModel, SdfWorld, load_world_file
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of

Rectangle = tuple[float, float, float, float]
"""x0, y0, x1, y1, m."""

_FLAT = 0.05  # m, height below which a shape counts as ground


class FreeGround:
    """The free ground of a world: without visuals or collisions on or above it."""

    def __init__(self, world: SdfWorld) -> None:
        """Store the bounding rectangles, along x and y, of all shapes of ``world``."""
        boxes = []
        for model in world.models:
            for link in model.links:
                frame = compose(model.pose, link.pose)
                shapes = [(v.geometry, v.pose) for v in link.visuals] + [(c.geometry, c.pose) for c in link.collisions]
                for geometry, pose in shapes:
                    low, high = box_of(geometry, compose(frame, pose))
                    if high[2] > _FLAT:
                        boxes.append((low[0], low[1], high[0], high[1]))
        self._boxes: NDArray[np.float64] = np.array(boxes, float).reshape(-1, 4)

    def is_free(self, x: float, y: float, radius: float) -> bool:
        """Return whether the ground within ``radius`` m of (x, y) is free."""
        boxes = self._boxes
        dx = np.maximum(np.maximum(boxes[:, 0] - x, x - boxes[:, 2]), 0.0)
        dy = np.maximum(np.maximum(boxes[:, 1] - y, y - boxes[:, 3]), 0.0)
        return not bool(np.any(dx * dx + dy * dy <= radius * radius))

    def is_free_way(self, start: tuple[float, float], end: tuple[float, float], radius: float) -> bool:
        """Return whether the line between two points is free, sampled every ``radius``, m."""
        pieces = max(1, math.ceil(math.dist(start, end) / radius))
        return all(
            self.is_free(
                start[0] + (end[0] - start[0]) * k / pieces, start[1] + (end[1] - start[1]) * k / pieces, radius
            )
            for k in range(pieces + 1)
        )


START: Rectangle = (-3.0, -3.0, 18.0, 13.0)
"""x0, y0, x1, y1, m: empty in every world, so that the fleet's spawn grid is free."""
BESIDE = 20.0
"""x, m, at which buildings begin, with their entrance towards the start area."""

_TILE = 256.0  # m, side of a tile of ground
_GROUND = -0.06  # m, thickness below the shapes that lie on the ground
_WHITE = (1.0, 1.0, 1.0, 1.0)


def box(size: tuple[float, float, float], centre: tuple[float, float, float], colour: Colour) -> Visual:
    """Return a box with edges along the axes, m."""
    x, y, z = (round(value, 4) for value in centre)
    a, b, c = (round(value, 4) for value in size)
    return Visual(Box((a, b, c)), Pose((x, y, z)), colour)


def solid(name: str, shapes: Iterable[Visual], ghosts: Iterable[Visual] = ()) -> SdfModel:
    """Return a static model: shapes that collide, and ``ghosts`` that are only visible."""
    shapes = tuple(shapes)
    collisions = tuple(Collision(shape.geometry, shape.pose) for shape in shapes)
    return SdfModel(name, links=(SdfLink("link", visuals=(*shapes, *ghosts), collisions=collisions),))


def place(name: str, thing: Thing, x: float, y: float, yaw: float) -> SdfModel:
    """Return an object of the scenery at a place, m, turned by ``yaw``, rad."""
    link = SdfLink("link", visuals=thing.visuals, collisions=thing.collisions)
    return SdfModel(name, Pose((round(x, 3), round(y, 3), 0.0), from_euler(0.0, 0.0, round(yaw, 3))), True, (link,))


def ground(texture: str, region: Rectangle, number: int = 0) -> SdfModel:
    """Return textured ground far beyond a region; the physical ground is the plane z = 0."""
    x0, y0, x1, y1 = region
    across = [2 * math.ceil(0.5 * side / _TILE) + 1 for side in (x1 - x0, y1 - y0)]
    tiles = []
    for i in range(across[0]):
        for j in range(across[1]):
            x = round(0.5 * (x0 + x1) + (i - 0.5 * (across[0] - 1)) * _TILE, 3)
            y = round(0.5 * (y0 + y1) + (j - 0.5 * (across[1] - 1)) * _TILE, 3)
            form = Mesh(assets.mesh("ground"), (_TILE, _TILE, 1.0))
            tiles.append(Visual(form, Pose((x, y, _GROUND)), _WHITE, assets.texture(texture, number)))
    return SdfModel("ground", links=(SdfLink("link", visuals=tuple(tiles)),))


def world(name: str, models: Iterable[SdfModel], light: Light | None = None) -> SdfWorld:
    """Return a world with the surroundings of ``empty``."""
    return replace(load_world_file("empty"), name=name, models=tuple(models), light=light or Light())


class Places:
    """Circles on the ground that keep apart from each other and from the start area."""

    def __init__(self, rng: np.random.Generator, region: Rectangle, *, clear: Rectangle | None = START) -> None:
        """Start with an empty region, m; ``clear`` stays free."""
        self._rng, self._region, self._clear = rng, region, clear
        self._circles = np.zeros((0, 3))

    def take(self, radius: float, gap: float, tries: int = 60) -> tuple[float, float] | None:
        """Occupy a random place for a circle, ``gap`` m from all others; None if none was found."""
        x0, y0, x1, y1 = self._region
        if x1 - x0 < 2.0 * radius or y1 - y0 < 2.0 * radius:
            return None
        for _ in range(tries):
            x = round(float(self._rng.uniform(x0 + radius, x1 - radius)), 3)
            y = round(float(self._rng.uniform(y0 + radius, y1 - radius)), 3)
            if self.is_free(x, y, radius, gap):
                self.occupy(x, y, radius)
                return x, y
        return None

    def occupy(self, x: float, y: float, radius: float) -> None:
        """Occupy a circle, m."""
        self._circles = np.vstack([self._circles, (x, y, radius)])

    def is_free(self, x: float, y: float, radius: float, gap: float) -> bool:
        """Return whether a circle is ``gap`` m from all others, and outside the start area."""
        if self._clear is not None:
            x0, y0, x1, y1 = self._clear
            if math.hypot(max(x0 - x, 0.0, x - x1), max(y0 - y, 0.0, y - y1)) < radius:
                return False
        circles = self._circles
        distance = np.hypot(circles[:, 0] - x, circles[:, 1] - y)
        return bool((distance >= radius + circles[:, 2] + gap).all())
