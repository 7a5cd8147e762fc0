"""Registration of two maps, and validation of the result.

Generalised ICP (A. Segal et al., RSS 2009; ``small_gicp``) aligns the second map with the first, starting from the
relative estimates. The ground matches any other ground, so only vertical surfaces count as overlap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from xtdrone_common.pose_matrices import transform_points
from xtdrone_planning.merging.frame_links import Link
from xtdrone_planning.merging.settings import FitSettings, NotMergedError

Array = NDArray[np.float64]

_NEIGHBOURS = 20
_LEAST_POINTS = 2 * _NEIGHBOURS
_ITERATIONS = 40
_COARSE = 3.0  # standard deviations of the relative estimates: correspondence distance of the first registration
_UPRIGHT = 0.5  # maximum |z| of the normal of a vertical surface
_TURN_NOISE = 0.05  # rad, of the registration
_NEARBY = 4.0  # times the correspondence distance: within it both maps should have the same surfaces


class Surfaces(NamedTuple):
    """A map prepared for registration.

    Attributes:
        cloud: Cloud of small_gicp, with covariances.
        tree: Tree of small_gicp.
        upright: (m, 3) m, its points on vertical surfaces.
        normals: (m, 3) of these.
    """

    cloud: small_gicp.PointCloud
    tree: small_gicp.KdTree
    upright: Array
    normals: Array


class Fit(NamedTuple):
    """Result of the registration of two maps.

    Attributes:
        pose: (4, 4) of the second map in the first.
        overlap: fraction of the smaller map's vertical surfaces that coincide with the other's.
        agreement: fraction of nearby points that coincide.
        residual: m, RMS distance from the other map's surfaces.
    """

    pose: Array
    overlap: float
    agreement: float
    residual: float


def surfaces_of(points: Array, settings: FitSettings) -> Surfaces | None:
    """Return a map's surfaces, or None if it has too few points.

    Args:
        points: (n, 3) m, finite.
        settings: Settings of the registration.
    """
    if len(points) < _LEAST_POINTS:
        return None
    cloud, tree = small_gicp.preprocess_points(points, settings.cell, _NEIGHBOURS, 1)
    if cloud.size() < _LEAST_POINTS:
        return None
    small_gicp.estimate_normals(cloud, tree, _NEIGHBOURS, 1)
    normals = np.asarray(cloud.normals())[:, :3]
    upright = np.abs(normals[:, 2]) <= _UPRIGHT
    return Surfaces(cloud, tree, np.asarray(cloud.points())[upright, :3], normals[upright])


def fit_of(first: Surfaces | None, second: Surfaces | None, link: Link, settings: FitSettings) -> Fit:
    """Register the second map with the first.

    Args:
        first, second: the maps.
        link: pose of the second in the first by relative estimates.
        settings: Settings of the registration.

    Raises:
        NotMergedError: the maps do not match.
    """
    if first is None or second is None:
        raise NotMergedError("a map has too few points so far")
    pose, weakest = _align(first, second, link, settings)
    found = _assess(first, second, pose, settings)
    if weakest < settings.weakest:
        raise NotMergedError(f"the surfaces do not determine the position: information ratio {weakest:.3f}")
    tilt = float(np.arccos(np.clip(pose[2, 2], -1.0, 1.0)))
    if tilt > settings.most_tilt:
        raise NotMergedError(f"the maps match only with a tilt of {tilt:.2f} rad")
    off = link.contradiction(pose, (settings.cell, _TURN_NOISE))
    if off > settings.contradiction:
        raise NotMergedError(f"the maps match {off:.1f} standard deviations away from the relative estimates")
    return found


def _align(first: Surfaces, second: Surfaces, link: Link, settings: FitSettings) -> tuple[Array, float]:
    """Return the best pose (4, 4), and the ratio of the smallest to the largest information on the position."""
    pose = link.pose
    for reach in (max(_COARSE * link.deviation, 2.0 * settings.reach), settings.reach):
        result = small_gicp.align(
            first.cloud,
            second.cloud,
            first.tree,
            pose,
            max_correspondence_distance=reach,
            num_threads=1,
            max_iterations=_ITERATIONS,
        )
        pose = np.asarray(result.T_target_source)
    values = np.linalg.eigvalsh(np.asarray(result.H)[3:, 3:])  # rotation comes first
    return pose, float(max(values[0], 0.0) / values[-1]) if values[-1] > 0.0 else 0.0


def _assess(first: Surfaces, second: Surfaces, pose: Array, settings: FitSettings) -> Fit:
    """Return the fit at a pose (4, 4).

    Raises:
        NotMergedError: overlap or agreement is too low, or the residual too large.
    """
    least = min(len(first.upright), len(second.upright))
    if least < settings.least_points:
        raise NotMergedError(f"a map has {least} points on vertical surfaces, {settings.least_points} are needed")
    moved = transform_points(pose, second.upright)
    distance, nearest = cKDTree(first.upright).query(moved, distance_upper_bound=_NEARBY * settings.reach)
    meets, near = distance <= settings.reach, np.isfinite(distance)
    overlap = min(float(meets.sum()) / least, 1.0)
    if meets.sum() < settings.least_points or overlap < settings.least_overlap:
        raise NotMergedError(f"the maps overlap by only {100 * overlap:.0f} % ({meets.sum()} points)")
    agreement = float(meets.sum() / near.sum())
    if agreement < settings.least_agreement:
        raise NotMergedError(f"only {100 * agreement:.0f} % of the nearby surfaces agree")
    off = np.einsum("ni,ni->n", moved[meets] - first.upright[nearest[meets]], first.normals[nearest[meets]])
    residual = float(np.sqrt(np.mean(off**2)))
    if residual > settings.most_residual:
        raise NotMergedError(f"the maps are {residual:.2f} m apart where they overlap")
    return Fit(pose, overlap, agreement, residual)
