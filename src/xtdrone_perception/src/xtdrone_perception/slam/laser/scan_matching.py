"""Matching of levelled laser scans to a map of points: point-to-line ICP in the plane.

The metric is that of A. Censi (An ICP variant using a point-to-line metric, ICRA 2008), with the line at a map point
fitted to its neighbours in its own scan, Huber weights, and Gauss-Newton steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

_ITERATIONS = 25
_SMALL = 1e-5  # m and rad: smaller steps end the iteration
_KNEE = 2.0  # normalised residual beyond which weights decrease
_GAP = 0.4  # m: maximum gap between neighbouring points on one surface
_SIDE = 3  # neighbours on each side to which the line is fitted
_CELL = 0.05  # m, cell size; the map keeps one point per cell
_MOST = 60_000  # points of the map; the oldest are dropped


class Match(NamedTuple):
    """Result of matching a scan.

    Attributes:
        place: (3,) x, y (m), yaw (rad).
        share: fraction of points that have a correspondence.
        residual: RMS of the normalised distances from the lines.
        information: (3, 3) of x, y, yaw.
    """

    place: Array
    share: float
    residual: float
    information: Array


def normals_of(points: Array) -> Array:
    """Return unit normals (n, 2) of a scan's surface, NaN where neighbours do not lie on a line.

    Args:
        points: (n, 2) m, in the order of the rays, counter-clockwise or clockwise.
    """
    shifted = np.stack([np.roll(points, k, axis=0) for k in range(-_SIDE, _SIDE + 1)], axis=1)
    near = np.linalg.norm(shifted - points[:, None], axis=2) <= _GAP
    count = near.sum(axis=1)
    middle = (shifted * near[:, :, None]).sum(axis=1) / count[:, None]
    off = (shifted - middle[:, None]) * near[:, :, None]
    xx, xy, yy = (off[..., 0] ** 2).sum(1), (off[..., 0] * off[..., 1]).sum(1), (off[..., 1] ** 2).sum(1)
    along = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    spread = np.hypot(xx - yy, 2.0 * xy)
    is_line = (count >= 3) & (spread > 0.8 * (xx + yy)) & (xx + yy > 0.0)
    normals = np.stack([-np.sin(along), np.cos(along)], axis=1)
    found: Array = np.where(is_line[:, None], normals, np.nan)
    return found


class LineMap:
    """Points with normals, one per cell."""

    def __init__(self) -> None:
        """Start empty."""
        self.points, self._normals = np.empty((0, 2)), np.empty((0, 2))
        self._tree: cKDTree | None = None

    def __len__(self) -> int:
        return len(self.points)

    def insert(self, points: Array, normals: Array) -> None:
        """Add points (n, 2) m with their normals; points without a normal or in occupied cells are skipped."""
        good = np.isfinite(normals).all(axis=1)
        joined = np.concatenate([self.points, points[good]])
        _, first = np.unique(np.floor(joined / _CELL).astype(np.int64), axis=0, return_index=True)
        kept = np.sort(first)[-_MOST:]
        self.points, self._normals = joined[kept], np.concatenate([self._normals, normals[good]])[kept]
        self._tree = cKDTree(self.points)

    def match(self, points: Array, start: Array, reach: float, noise: float) -> Match:
        """Match a scan to the map.

        Args:
            points: (n, 2) m, in the horizontal plane, relative to the body.
            start: (3,) x, y (m), yaw (rad), initial guess.
            reach: maximum distance of correspondences, m; it shrinks to a third.
            noise: standard deviation of a distance from a line, m.
        """
        place, information, residual, share = start.copy(), np.zeros((3, 3)), np.zeros(0), 0.0
        for k in range(_ITERATIONS):
            near = max(reach * 0.8**k, reach / 3.0)
            slopes, residual, share = self._rows(points, place, near, noise)
            weight = np.minimum(1.0, _KNEE / np.maximum(np.abs(residual), 1e-12))
            information = (slopes * weight[:, None]).T @ slopes
            step = np.linalg.solve(information + 1e-6 * np.eye(3), -(slopes * weight[:, None]).T @ residual)
            place = place + step
            if np.abs(step).max() < _SMALL:
                break
        square = float(np.mean(residual**2)) if len(residual) else 0.0
        return Match(place, share, float(np.sqrt(square)), information)

    def _rows(self, points: Array, place: Array, reach: float, noise: float) -> tuple[Array, Array, float]:
        """Return derivatives (m, 3) and normalised residuals (m,) of the correspondences, and their fraction."""
        sin, cos = np.sin(place[2]), np.cos(place[2])
        turned = points @ np.array([[cos, sin], [-sin, cos]])
        moved = turned + place[:2]
        assert self._tree is not None  # the map has points
        distance, index = self._tree.query(moved, distance_upper_bound=reach)
        found = np.isfinite(distance)
        index, turned, moved = index[found], turned[found], moved[found]
        normals = self._normals[index]
        residual = np.einsum("ni,ni->n", normals, moved - self.points[index])
        turn = normals[:, 1] * turned[:, 0] - normals[:, 0] * turned[:, 1]
        return np.column_stack([normals, turn]) / noise, residual / noise, float(found.mean()) if len(found) else 0.0
