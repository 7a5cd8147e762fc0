"""Distances between places and the solid shapes of a world: boxes, cylinders and spheres exactly."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_control.poses import Pose, compose
from xtdrone_sim.shapes.visual import Box, Cylinder, Mesh, Sphere
from xtdrone_sim.worlds.sdf import SdfModel

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
