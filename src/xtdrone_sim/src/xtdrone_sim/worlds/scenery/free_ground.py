"""Test for free ground in a world."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from xtdrone_sim.shapes.pose_arithmetic import compose
from xtdrone_sim.worlds.sdf import SdfWorld
from xtdrone_sim.worlds.sdf.geometries.visuals_and_collisions import box_of

Rectangle = tuple[float, float, float, float]
"""x0, y0, x1, y1, m."""

_FLAT = 0.05  # m, height below which a shape counts as ground


class Ground:
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
