"""Shapes of links as surfaces of a tree."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose, compose
from xtdrone_sim.rays.tree import BOX, CYLINDER, SPHERE, SURFACE, TRIANGLE
from xtdrone_worlds.shapes.triangles import rotation_matrix, triangles_of
from xtdrone_worlds.shapes.visual import Box, Collision, Cylinder, Geometry, Mesh, Sphere, Visual
from xtdrone_worlds.worlds.sdf import SdfModel

_OPAQUE = 0.5  # minimum opacity of a visual that rays see


def visible_shapes(visuals: Sequence[Visual], collisions: Sequence[Collision] = ()) -> list[tuple[Geometry, Pose]]:
    """Return the shapes of a link that rays hit: its opaque visuals, or without visuals its collision shapes."""
    if visuals:
        return [(visual.geometry, visual.pose) for visual in visuals if visual.colour[3] >= _OPAQUE]
    return [(collision.geometry, collision.pose) for collision in collisions]


def visible_shapes_of(model: SdfModel) -> list[tuple[Geometry, Pose]]:
    """Return the shapes of a model that rays hit, with poses in its frame; see ``seen``."""
    return [
        (geometry, compose(link.pose, pose))
        for link in model.links
        for geometry, pose in visible_shapes(link.visuals, link.collisions)
    ]


def surfaces_of(shapes: Iterable[tuple[Geometry, Pose]], owner: int) -> NDArray[np.void]:
    """Return the surfaces (n,) ``SURFACE`` of placed shapes.

    Raises:
        MeshError: a mesh file cannot be read.
    """
    parts = [of_shape(geometry, pose, owner) for geometry, pose in shapes]
    return np.concatenate(parts) if parts else np.zeros(0, SURFACE)


def of_shape(geometry: Geometry, pose: Pose, owner: int) -> NDArray[np.void]:
    """Return the surfaces of one shape: one record, or one for each triangle of a mesh.

    Raises:
        MeshError: a mesh file cannot be read.
    """
    if isinstance(geometry, Mesh):
        return of_triangles(_corners(geometry) @ rotation_matrix(pose).T + pose.position, owner)
    surface = np.zeros(1, SURFACE)
    turn = rotation_matrix(pose).T
    surface["owner"], surface["a"] = owner, pose.position
    surface["b"], surface["c"], surface["d"] = turn
    if isinstance(geometry, Box):
        surface["kind"], surface["size"] = BOX, 0.5 * np.asarray(geometry.size)
    elif isinstance(geometry, Sphere):
        surface["kind"], surface["size"] = SPHERE, (geometry.radius, 0.0, 0.0)
    elif isinstance(geometry, Cylinder):
        surface["kind"], surface["size"] = CYLINDER, (geometry.radius, 0.5 * geometry.length, 0.0)
    return surface


@lru_cache(maxsize=256)
def _corners(mesh: Mesh) -> NDArray[np.float64]:
    """Return the corners (n, 3, 3) of a mesh, m; a world has the same one in many places."""
    return triangles_of(mesh).points


def of_triangles(points: NDArray[np.float64], owner: int) -> NDArray[np.void]:
    """Return triangles (n, 3, 3), m, as surfaces (n,)."""
    surfaces = np.zeros(len(points), SURFACE)
    surfaces["kind"], surfaces["owner"] = TRIANGLE, owner
    surfaces["a"] = points[:, 0]
    surfaces["b"] = points[:, 1] - points[:, 0]
    surfaces["c"] = points[:, 2] - points[:, 0]
    return surfaces
