"""How well a map agrees with the true surfaces: chamfer distance, precision, recall and F-score.

Precision and recall at a distance as A. Knapitsch et al. define them (Tanks and Temples, ACM Transactions on Graphics
36, 2017): precision is the share of the map within that distance of a true surface, recall the share of the true
surfaces within it of the map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

WITHIN = 0.1
"""Distance of precision and recall, m."""


@dataclass(frozen=True)
class MapAccuracy:
    """A map against the truth.

    Attributes:
        points: number of points of the map.
        surface_points: number of points on the true surfaces that could be seen.
        error: mean distance of the map's points from the true surfaces, m.
        gap: mean distance of the surfaces' points from the map, m; None without any.
        chamfer: mean of both, m; None without gap.
        precision: share of the map's points within 0.1 m of a surface.
        recall: share of the surfaces' points within 0.1 m of the map; None without any.
        f_score: harmonic mean of precision and recall.
    """

    points: int
    surface_points: int
    error: float
    gap: float | None
    chamfer: float | None
    precision: float
    recall: float | None
    f_score: float | None


def map_accuracy(errors: Array, found: Array, surface_points: Array) -> MapAccuracy:
    """Compare a map with the truth.

    Args:
        errors: (n,) distances of the map's points from the nearest true surface, m.
        found: (n, 3) the points of the map, m, at least one.
        surface_points: (m, 3) points on the surfaces that could be seen, m.
    """
    error, precision = float(errors.mean()), float((errors <= WITHIN).mean())
    if not len(surface_points):
        return MapAccuracy(len(found), 0, error, None, None, precision, None, None)
    gaps, _ = cKDTree(found).query(surface_points)
    gap, recall = float(gaps.mean()), float((gaps <= WITHIN).mean())
    both = precision + recall
    f_score = 2.0 * precision * recall / both if both else 0.0
    return MapAccuracy(len(found), len(surface_points), error, gap, 0.5 * (error + gap), precision, recall, f_score)
