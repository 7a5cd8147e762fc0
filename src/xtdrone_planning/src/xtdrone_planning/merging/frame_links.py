"""Relative pose of two vehicles' map frames, from one vehicle's estimates of the other's position over time.

If vehicle A is at a in its map and estimates B at r relative to itself (in the axes of A's map), and B is at b in B's
map, then the pose (R, t) of B's map in A's satisfies a + r = R b + t. Both maps have z up, so R is a rotation about z:
rotation and translation follow in closed form (two-dimensional case of B. Horn, JOSA A 4(4), 1987), with the compass as
a prior of the rotation. The Geman-McClure kernel, narrowed step by step, suppresses outliers (H. Yang et al., Graduated
Non-Convexity for Robust Spatial Perception, RA-L 5(2), 2020).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.pose_matrices import inverse, pose_of, transform_points, turned_about_z, yaw_of
from xtdrone_planning.merging.settings import LinkSettings, NotMergedError

Array = NDArray[np.float64]

_NARROWER = 1.4  # factor by which the kernel narrows in each step


class Pairs(NamedTuple):
    """Estimates of one vehicle's position by another.

    Attributes:
        times: (n,) s, ascending.
        seen: (n, 3) m, estimated positions of the other vehicle, in the observer's map.
        other: (n, 3) m, its positions by its own odometry, in its map.
        deviations: (n,) m, standard deviation of ``seen``, per axis.
    """

    times: Array
    seen: Array
    other: Array
    deviations: Array


class Link(NamedTuple):
    """Relative pose of two maps.

    Attributes:
        pose: (4, 4) of the second map in the first.
        middle: (3,) m, second map: the point to which the covariance refers.
        covariance: (4, 4) of x, y, z of this point in the first map, m, and of the heading, rad.
        inliers: fraction of estimates that are inliers.
        estimates: their number.
    """

    pose: Array
    middle: Array
    covariance: Array
    inliers: float
    estimates: int

    @property
    def deviation(self) -> float:
        """Standard deviation of the position in the worst direction, m."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def heading_deviation(self) -> float:
        """Standard deviation of the heading, rad."""
        return float(np.sqrt(self.covariance[3, 3]))

    def contradiction(self, pose: Array, noise: tuple[float, float]) -> float:
        """Return the distance of another estimate of the pose, in standard deviations.

        Args:
            pose: (4, 4) of the second map in the first.
            noise: its own standard deviation, m and rad.
        """
        shift = transform_points(pose, self.middle) - transform_points(self.pose, self.middle)
        off = np.append(shift, yaw_of(inverse(self.pose) @ pose))
        covariance = self.covariance + np.diag([noise[0] ** 2] * 3 + [noise[1] ** 2])
        return float(np.sqrt(off @ np.linalg.solve(covariance, off)))

    def reversed(self) -> Link:
        """Return the pose of the first map in the second."""
        back = inverse(self.pose)
        turn = np.eye(4)
        turn[:3, :3] = back[:3, :3]
        middle = transform_points(self.pose, self.middle)  # at this point the pose and its inverse have the same error
        return Link(back, middle, turn @ self.covariance @ turn.T, self.inliers, self.estimates)


def link_of(pairs: Pairs, settings: LinkSettings) -> Link:
    """Return the pose of the other vehicle's map in the observer's.

    Raises:
        NotMergedError: there are too few estimates, they are inconsistent, or the pose is too uncertain.
    """
    count = len(pairs.times)
    if count < settings.least_samples:
        raise NotMergedError(f"{count} relative estimates, at least {settings.least_samples} are needed")
    information = 1.0 / (pairs.deviations**2 + settings.pose_noise**2)
    good = _inliers(pairs, information, settings)
    share = float(good.mean())
    if share < settings.least_inliers:
        raise NotMergedError(f"only {100 * share:.0f} % of the relative estimates agree")
    pose = _closed_form(pairs, information * good, settings)
    middle = np.average(pairs.other, axis=0, weights=information * good)
    covariance = _covariance(pairs, information * good, pose, middle, settings)
    link = Link(pose, middle, covariance, share, count)
    if link.deviation > settings.worst_position:
        raise NotMergedError(
            f"standard deviation of the position: {link.deviation:.2f} m, "
            f"at most {settings.worst_position:g} m is allowed"
        )
    if link.heading_deviation > settings.worst_heading:
        raise NotMergedError(
            f"standard deviation of the heading: {link.heading_deviation:.2f} rad, "
            f"at most {settings.worst_heading:g} rad is allowed"
        )
    return link


def _inliers(pairs: Pairs, information: Array, settings: LinkSettings) -> NDArray[np.bool_]:
    """Return which estimates (n,) are inliers."""
    limit = settings.gate**2
    squares = _squares(pairs, information, _closed_form(pairs, information, settings))
    wide = max(2.0 * float(squares.max()) / limit, 1.0)
    while True:
        weights = (wide / (squares / limit + wide)) ** 2
        squares = _squares(pairs, information, _closed_form(pairs, information * weights, settings))
        if wide == 1.0:
            return squares <= limit
        wide = max(wide / _NARROWER, 1.0)


def _closed_form(pairs: Pairs, weights: Array, settings: LinkSettings) -> Array:
    """Return the weighted least-squares pose (4, 4).

    The prior of the rotation is a von Mises distribution: the heading's information times its cosine.
    """
    total = weights.sum()
    seen, other = weights @ pairs.seen / total, weights @ pairs.other / total
    a, b = pairs.other - other, pairs.seen - seen
    along = weights @ (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]) + settings.heading_deviation**-2.0
    across = weights @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    turn = turned_about_z(float(np.arctan2(across, along)))
    return pose_of(seen - turn.apply(other), turn)


def _squares(pairs: Pairs, information: Array, pose: Array) -> Array:
    off = pairs.seen - transform_points(pose, pairs.other)
    squares: Array = information * np.einsum("ni,ni->n", off, off)
    return squares


def _covariance(pairs: Pairs, weights: Array, pose: Array, middle: Array, settings: LinkSettings) -> Array:
    """Return the covariance (4, 4) of the point ``middle`` and of the heading.

    Estimates within ``correlation`` seconds count as one; residuals larger than expected increase it.
    """
    good = weights > 0.0
    bins = np.floor(pairs.times[good] / settings.correlation) if settings.correlation else pairs.times[good]
    fresh = len(np.unique(bins)) / good.sum()
    misfit = max(1.0, float(_squares(pairs, weights, pose).sum()) / (3.0 * good.sum()))
    arms = (pairs.other - middle) @ pose[:3, :3].T
    slopes = np.zeros((len(arms), 3, 4))
    slopes[:, :, :3] = np.eye(3)
    slopes[:, 0, 3], slopes[:, 1, 3] = -arms[:, 1], arms[:, 0]
    information = np.einsum("n,nij,nik->jk", weights, slopes, slopes) * fresh / misfit
    information[3, 3] += settings.heading_deviation**-2.0
    return np.linalg.inv(information)
