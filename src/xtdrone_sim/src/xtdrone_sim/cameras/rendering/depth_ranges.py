"""Depth ranges in which an image is drawn.

The EGL plugin's depth buffer has 16 bits, nearly all of which resolve depths close to the near limit: with a limit of
5 cm, surfaces 10 cm apart merge at a distance of 20 m. So the near limit is moved out as far as possible without
cutting off a visible surface, and a view with close objects is drawn as two images, one of the near range and one of
the rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.cameras.pinhole import Pinhole
from xtdrone_common.poses import Pose
from xtdrone_worlds.shapes.triangles import rotation_matrix

SPLIT = 2.0  # m; nearer surfaces are drawn in a separate image

Array = NDArray[np.float64]


class Extents:
    """Positions and sizes of the bodies."""

    def __init__(self) -> None:
        """Create an object without bodies."""
        self._corners: list[Array] = []  # of each body's triangles, (n, 3, 3), own frame
        self._low = np.empty((0, 3))
        self._high = np.empty((0, 3))
        self._turns = np.empty((0, 3, 3))
        self._places = np.empty((0, 3))
        self._shown = np.empty(0, bool)

    def add(self, corners: Array) -> None:
        """Add the next body, at the origin, by the corners of its triangles, shape (n, 3, 3), m."""
        some = len(corners) > 0
        self._corners.append(corners)
        self._low = np.concatenate([self._low, [corners.min(axis=(0, 1)) if some else np.zeros(3)]])
        self._high = np.concatenate([self._high, [corners.max(axis=(0, 1)) if some else np.zeros(3)]])
        self._turns = np.concatenate([self._turns, [np.eye(3)]])
        self._places = np.concatenate([self._places, np.zeros((1, 3))])
        self._shown = np.append(self._shown, some)

    def place(self, body: int, pose: Pose | None) -> None:
        """Store the pose of a body; None: hidden."""
        self._shown[body] = pose is not None and len(self._corners[body]) > 0
        if pose is not None:
            self._turns[body] = rotation_matrix(pose)
            self._places[body] = pose.position

    def ranges(self, pinhole: Pinhole, pose: Pose, near: float, far: float) -> list[tuple[float, float]]:
        """Return the limits, m, of the images to draw on top of each other, the farthest first.

        Args:
            pinhole: projection.
            pose: pose of the optical frame in the world.
            near, far: requested limits, m.
        """
        if near >= SPLIT or far <= SPLIT:
            return [(near, far)]
        eye, turn = np.asarray(pose.position, float), rotation_matrix(pose)
        seen = np.einsum("bij,bi->bj", self._turns, eye - self._places)  # the eye in the frames of the bodies
        apart = np.linalg.norm(np.maximum(self._low - seen, 0.0) + np.maximum(seen - self._high, 0.0), axis=1)
        x = max(pinhole.cx, pinhole.width - pinhole.cx) / pinhole.fx
        y = max(pinhole.cy, pinhole.height - pinhole.cy) / pinhole.fy
        least = np.where(
            self._shown, apart / np.sqrt(1.0 + x * x + y * y), np.inf
        )  # minimum depth of any visible point
        for body in np.flatnonzero(least < SPLIT):
            corners = self._corners[body] @ self._turns[body].T + self._places[body]
            depths = _depths_in_view(pinhole, (corners - eye) @ turn, near)
            least[body] = depths.min(initial=np.inf)
        nearest = least.min(initial=np.inf)
        if nearest < SPLIT:
            return [(SPLIT, far), (near, SPLIT)]
        return [(min(nearest, 0.5 * (SPLIT + far)) * 0.999, far)]


def _depths_in_view(pinhole: Pinhole, corners: Array, near: float) -> Array:
    """Return the minimum depths of the triangles that may be visible, without those certainly outside the image.

    Args:
        pinhole: projection.
        corners: corners of the triangles, shape (n, 3, 3), m, optical frame.
        near: near limit, m.
    """
    x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
    outside = [
        z < near,
        pinhole.fx * x + pinhole.cx * z < 0.0,
        pinhole.fx * x + (pinhole.cx - pinhole.width) * z > 0.0,
        pinhole.fy * y + pinhole.cy * z < 0.0,
        pinhole.fy * y + (pinhole.cy - pinhole.height) * z > 0.0,
    ]
    seen = ~np.any([side.all(axis=1) for side in outside], axis=0)
    return np.maximum(z[seen].min(axis=1), near) if seen.any() else np.empty(0)
