"""Camera model of visual odometry: pose in the body, and measurement of a point.

A measurement of a point is (u, v, 1 / z, slopes of 1 / z along u and v): pixel, inverse depth there, and how it changes
about that pixel. The errors of depths by stereo and by structured light are those of a disparity, so that of the
inverse depth is the same near and far. A corner that was followed a pixel too far has the depth of the surface one
pixel farther: on ground seen at a grazing angle that is metres. The inverse depth is therefore compared at the pixel
where the point is expected, which is exact on a plane: error and depth of the pixel do not count twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NEAREST = 0.05  # m, minimum depth of a point


@dataclass(frozen=True)
class BodyCamera:
    """A pinhole camera without distortion, fixed to the body.

    Attributes:
        focal: (2,) fx, fy, px.
        centre: (2,) px, of the principal point; the centre of the upper left pixel is (0, 0).
        mount: (4, 4) optical frame (x right, y down, z ahead) to body (FLU).
    """

    focal: Array
    centre: Array
    mount: Array

    def measure(self, pose: Array, points: Array) -> tuple[Array, Array]:
        """Return the predicted measurements, (n, 3), and the points in the camera's frame, (n, 3) m.

        Args:
            pose: (4, 4) body to map.
            points: (n, 3) m, map.
        """
        body = (points - pose[:3, 3]) @ pose[:3, :3]
        local = (body - self.mount[:3, 3]) @ self.mount[:3, :3]
        depth = np.maximum(local[:, 2], _NEAREST)
        return np.column_stack([local[:, :2] / depth[:, None] * self.focal + self.centre, 1.0 / depth]), local

    def residuals(self, measured: Array, expected: Array) -> Array:
        """Return measured (n, 5) less expected (n, 3) values, (n, 3): px, px, 1/m at the expected pixel."""
        found = measured[:, :3] - expected
        found[:, 2] -= np.einsum("ni,ni->n", measured[:, 3:], found[:, :2])
        return found

    def points(self, pose: Array, pixels: Array, depth: Array) -> Array:
        """Return the points (n, 3) m, map, of pixels (n, 2) at depths (n,) m."""
        rays = np.column_stack([(pixels - self.centre) / self.focal, np.ones(len(pixels))])
        body = (rays * depth[:, None]) @ self.mount[:3, :3].T + self.mount[:3, 3]
        found: Array = body @ pose[:3, :3].T + pose[:3, 3]
        return found

    def slopes(self, poses: Array, local: Array, points: Array, measured: Array | None = None) -> tuple[Array, Array]:
        """Return the derivatives of measurements by pose, (n, 3, 6), and by point, (n, 3, 3).

        The pose is perturbed by a translation (m, map axes) and a rotation vector (rad, body axes).

        Args:
            poses: (n, 4, 4), body to map, of each measurement.
            local: (n, 3) m, in the camera's frame.
            points: (n, 3) m, map.
            measured: (n, 5): the derivatives are those of ``residuals``, with the other sign.
        """
        depth = np.maximum(local[:, 2], _NEAREST)
        optics = np.zeros((len(local), 3, 3))
        optics[:, 0, 0], optics[:, 1, 1] = self.focal[0] / depth, self.focal[1] / depth
        optics[:, 0, 2] = -self.focal[0] * local[:, 0] / depth**2
        optics[:, 1, 2] = -self.focal[1] * local[:, 1] / depth**2
        optics[:, 2, 2] = -1.0 / depth**2
        if measured is not None:
            optics[:, 2] -= np.einsum("ni,nij->nj", measured[:, 3:], optics[:, :2])
        turns = poses[:, :3, :3]
        by_body = np.einsum("nij,kj->nik", optics, self.mount[:3, :3])
        by_point = np.einsum("nij,nkj->nik", by_body, turns)
        body = np.einsum("nji,nj->ni", turns, points - poses[:, :3, 3])
        by_turn = np.einsum("nij,njk->nik", by_body, _cross_matrices(body))
        return np.concatenate([-by_point, by_turn], axis=2), by_point


def _cross_matrices(vectors: Array) -> Array:
    """Return the cross-product matrices (n, 3, 3) of vectors (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros(len(vectors))
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
