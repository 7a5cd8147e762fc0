"""Ground heights for wheels: the collision shapes of models, including heightmaps, and the plane z = 0."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.poses import Pose, compose
from xtdrone_sim.rays.scene import RayScene
from xtdrone_worlds.shapes.visual import Collision, Geometry, Mesh
from xtdrone_worlds.worlds.sdf import SdfLink, SdfModel
from xtdrone_worlds.worlds.sdf.geometries.heightmaps import is_terrain
from xtdrone_worlds.worlds.sdf.geometries.visuals_and_collisions import box_of

Array = NDArray[np.float64]


def shapes_of(models: Sequence[SdfModel]) -> list[tuple[Geometry, Pose]]:
    """Return the collision shapes of static models, with their poses in the world."""
    return [
        (shape.geometry, compose(compose(model.pose, link.pose), shape.pose))
        for model in models
        if model.static
        for link in model.links
        for shape in link.collisions
    ]


class SolidGround:
    """Shapes whose trees are built on the first query above them."""

    def __init__(self, shapes: Sequence[tuple[Geometry, Pose]]) -> None:
        """Compute the boxes of all shapes.

        Args:
            shapes: shapes with their poses in the world.

        Raises:
            SdfError: a mesh file cannot be read.
        """
        self._shapes = list(shapes)
        boxes = [np.concatenate(box_of(*shape)) for shape in self._shapes]
        self._boxes: Array = np.array(boxes, float).reshape(-1, 6)
        self._terrain = np.array([isinstance(form, Mesh) and is_terrain(form.path) for form, _ in shapes], bool)
        self._scenes: dict[int, RayScene] = {}

    @property
    def is_level(self) -> bool:
        """Whether there is only the plane."""
        return not self._shapes

    @property
    def has_terrain(self) -> bool:
        """Whether there are heightmaps."""
        return bool(self._terrain.any())

    def heights(self, points: Array) -> Array:
        """Return the height (n,), m, of the highest surface not above each of ``points`` (n, 3), m, map; at least 0."""
        return self._highest(points, np.ones(len(self._shapes), bool), np.zeros(len(points)))

    def terrain(self, places: Array) -> Array:
        """Return the height (n,), m, of the heightmaps at ``places`` (n, 2), m, map; minus infinity beside them."""
        above = np.column_stack([places, np.full(len(places), self._boxes[:, 5].max(initial=0.0) + 1.0)])
        return self._highest(above, self._terrain, np.full(len(places), -np.inf))

    def _highest(self, points: Array, wanted: NDArray[np.bool_], lowest: Array) -> Array:
        low, high, boxes = points.min(axis=0), points.max(axis=0), self._boxes
        near = wanted & (boxes[:, :2] <= high[:2]).all(axis=1) & (boxes[:, 3:5] >= low[:2]).all(axis=1)
        best = lowest
        for k in np.flatnonzero(near & (boxes[:, 2] <= high[2])).tolist():
            hits = self._scene(k).cast(points, np.tile((0.0, 0.0, -1.0), (len(points), 1)), 1e6)
            solid = hits.owners > 0
            best = np.where(solid, np.maximum(best, points[:, 2] - hits.ranges), best)
        return best

    def _scene(self, k: int) -> RayScene:
        if k not in self._scenes:
            geometry, pose = self._shapes[k]
            link = SdfLink("link", collisions=(Collision(geometry, pose),))
            self._scenes[k] = RayScene([SdfModel("shape", links=(link,))])
        return self._scenes[k]
