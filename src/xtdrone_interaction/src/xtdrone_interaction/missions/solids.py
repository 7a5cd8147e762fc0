"""The solid shapes of a world: distances from boxes, cylinders and spheres, exactly, and their outlines in a map."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose, compose, rotate
from xtdrone_worlds.shapes.visual import Box, Cylinder, Mesh, Sphere
from xtdrone_worlds.worlds.sdf import SdfModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solid:
    """A collision shape.

    Attributes:
        shape: a box, cylinder or sphere.
        pose: in map.
    """

    shape: Box | Cylinder | Sphere
    pose: Pose

    def distance(self, places: Array) -> Array:
        """Return the distances (n,), m, of places (n, 3) in map from the surface, 0 inside."""
        w, x, y, z = self.pose.orientation
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        local = (places - self.pose.position) @ rotation
        if isinstance(self.shape, Sphere):
            return np.maximum(np.linalg.norm(local, axis=1) - self.shape.radius, 0.0)
        if isinstance(self.shape, Cylinder):
            level = np.maximum(np.hypot(local[:, 0], local[:, 1]) - self.shape.radius, 0.0)
            return np.hypot(level, np.maximum(np.abs(local[:, 2]) - 0.5 * self.shape.length, 0.0))
        outside = np.maximum(np.abs(local) - 0.5 * np.array(self.shape.size), 0.0)
        return np.asarray(np.linalg.norm(outside, axis=1))


def solids_of(models: Iterable[SdfModel]) -> tuple[list[Solid], int]:
    """Return the collision shapes of a world's models, and the number of those that are meshes and left out."""
    solids, meshes = [], 0
    for model in models:
        for link in model.links:
            for collision in link.collisions:
                if isinstance(collision.geometry, Mesh):
                    meshes += 1
                    continue
                pose = compose(compose(model.pose, link.pose), collision.pose)
                solids.append(Solid(collision.geometry, pose))
    return solids, meshes


def least_distances_to(solids: Iterable[Solid], places: Array) -> Array:
    """Return each place's distance to the nearest solid, (n,), m; infinite without solids."""
    nearest = np.full(len(places), np.inf)
    for solid in solids:
        nearest = np.minimum(nearest, solid.distance(places))
    return nearest


def solids_of_world(world: str) -> list[Solid]:
    """Return the obstacles of a world, by its name or file.

    Raises:
        ValueError: no such world, or one that cannot be used.
    """
    from xtdrone_worlds.worlds.catalogue import load_world

    return solids_of(load_world(world).models)[0]


def draw_solids(axes: Axes, solids: Sequence[Solid], height: float) -> None:
    """Draw the obstacles at a height, m."""
    from matplotlib.collections import PatchCollection  # slow to import
    from matplotlib.patches import Circle, Patch, Polygon

    patches: list[Patch] = []
    for solid in solids:
        x, y, z = solid.pose.position
        if isinstance(solid.shape, Box):
            if abs(z - height) > 0.5 * solid.shape.size[2]:
                continue
            a, b = 0.5 * solid.shape.size[0], 0.5 * solid.shape.size[1]
            corners = [rotate(solid.pose.orientation, (u, v, 0.0)) for u, v in ((a, b), (-a, b), (-a, -b), (a, -b))]
            patches.append(Polygon([(x + u, y + v) for u, v, _ in corners]))
        elif isinstance(solid.shape, Cylinder):
            if abs(z - height) <= 0.5 * solid.shape.length:
                patches.append(Circle((x, y), solid.shape.radius))
        elif abs(z - height) < solid.shape.radius:
            patches.append(Circle((x, y), math.sqrt(solid.shape.radius**2 - (z - height) ** 2)))
    axes.add_collection(PatchCollection(patches, facecolor="0.45", edgecolor="0.25", linewidth=0.5))
