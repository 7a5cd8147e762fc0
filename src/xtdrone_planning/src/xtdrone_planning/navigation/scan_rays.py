"""Rays of a 2D lidar's scan, prepared for insertion into a plane map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.mapping.ray_places import place_rays

Array = NDArray[np.float64]


class ScanRays:
    """Rays of one scan in the lidar's frame.

    Attributes:
        ranges: (n,) m; up to the end of the free part of the ray.
        directions: (n, 3) unit vectors in base_link.
        times: (n,) s after the scan's stamp.
        hits: (n,) whether the ray ends at a surface.
    """

    def __init__(
        self, ranges: Array, first: float, step: float, time_step: float, limits: tuple[float, float], yaw: float
    ) -> None:
        """Read the values of a scan.

        A ray without a return is free up to the maximum range if its neighbours have none either, since a single
        missing return may be a dropout; rays below the minimum range and NaN are skipped (REP 117).

        Args:
            ranges: (n,) m; infinite: no return.
            first, step: angle of the first ray and between two rays, rad.
            time_step: between two rays, s.
            limits: minimum and maximum range, m.
            yaw: of the lidar in base_link, rad.
        """
        low, high = limits
        hits = np.isfinite(ranges) & (ranges >= low) & (ranges <= high)
        lost = (ranges == np.inf) | (np.isfinite(ranges) & (ranges > high))
        free = lost & np.roll(lost, 1) & np.roll(lost, -1)
        used = np.flatnonzero(hits | free)
        angles = first + yaw + step * used
        self.ranges = np.where(hits, ranges, high)[used]
        self.directions = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(used))])
        self.times = time_step * used
        self.hits = hits[used]

    def placed(self, poses: Array, spacing: float, mount: Array, slab: float) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return the start and end points of the rays, (n, 3) m in map, and which of them end at a surface.

        When the vehicle is tilted, a ray is cut off where it leaves the slab, because it may hit the ground.

        Args:
            poses, spacing, mount: see ``ray_places.place_rays``.
            slab: m above and below the lidar within which rays count.
        """
        origins, ends = np.empty_like(self.directions), np.empty_like(self.directions)
        place_rays(poses, spacing, mount, self.ranges, self.directions, self.times, origins, ends)
        climb = np.abs(ends[:, 2] - origins[:, 2])
        part = np.minimum(1.0, slab / np.maximum(climb, 1e-9))
        ends = origins + part[:, None] * (ends - origins)
        return origins, ends, self.hits & (part >= 1.0)
