"""Plane map: combines a given map with the scans of a 2D lidar, with distances to obstacles and costs.

Evidence is that of ``voxel_grid``, in a single layer. The costs are those of costmap_2d (D. Lu, D. Hershberger,
W. Smart, Layered costmaps for context-sensitive navigation, IROS 2014) as its publisher scales them. ``ScanRays`` are
the rays of a scan, prepared for insertion.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from xtdrone_planning.mapping.distance_field import distance_field
from xtdrone_planning.mapping.ray_casting import cast_rays
from xtdrone_planning.mapping.ray_places import place_rays
from xtdrone_planning.mapping.voxel_grid import FREE_TO, MOST, OCCUPIED_FROM
from xtdrone_planning.navigation.settings import CostmapSettings

Array = NDArray[np.float64]

LETHAL, INSCRIBED, UNKNOWN = 100, 99, -1
"""Costs of an obstacle, of cells where the vehicle's centre may not be, and of unknown cells."""

_STEEPNESS = 3.0  # 1/m, rate at which costs decrease with distance
_GIVEN_FROM = 65  # percent, from which a cell of a given map is occupied, as in map_server
_GIVEN_FREE_TO = 20
_MOST_GIVEN = 16_000_000  # cells of a given map: 4000 x 4000, as from SLAM; a larger one would exhaust memory
_FARTHEST_ORIGIN = 1e5  # m


class MapError(ValueError):
    """A given map that cannot be used; the message names the property, its value and what is allowed."""


class LevelMap:
    """A plane map.

    Attributes:
        cell: side of a cell, m.
        corner: (3,) index of the lowest cell; cell 0 begins at the origin of map; the third is 0.
        evidence: (nx, ny, 1) int16, log-odds in hundredths; see ``voxel_grid``.
        distance: (nx, ny, 1) float32, m to the nearest occupied cell, at most ``farthest``.
        farthest: m.
        is_ready: whether there is a map.
    """

    def __init__(self, settings: CostmapSettings) -> None:
        """Start without a map."""
        self.settings = settings
        self.cell = settings.cell
        self.farthest = settings.inflation + 2.0 * settings.cell
        self.restart()

    def restart(self) -> None:
        """Forget the map."""
        self.is_ready = False
        self._resize(np.zeros(2, np.int64), np.zeros((2, 2), np.int16))
        self.is_ready = False

    def _resize(self, first: NDArray[np.int64], evidence: NDArray[np.int16]) -> None:
        self.corner = np.array([*first.tolist(), 0], np.int64)
        self.evidence = np.ascontiguousarray(evidence[:, :, None])
        self._given = self.evidence.copy()
        self.distance = np.empty(self.evidence.shape, np.float32)
        self._touched = np.zeros(self.evidence.size + 1, np.uint8)
        self.is_ready = True
        self.update_distance()

    def begin_around(self, position: Array) -> None:
        """Start an unknown map around a position, (2,) or longer, m in map."""
        count = round(self.settings.side / self.cell)
        first = np.floor(np.asarray(position)[:2] / self.cell).astype(np.int64) - count // 2
        self._resize(first, np.zeros((count, count), np.int16))

    def take(self, values: NDArray[np.int8], origin: Array, cell: float) -> None:
        """Start with a given map; earlier observations are discarded.

        Args:
            values: (nx, ny) percent of occupation, -1 unknown.
            origin: (2,) lowest corner, m in map; it is rounded to the nearest corner of a cell.
            cell: side of its cells, m.

        Raises:
            MapError: the cell size differs, there are no cells or too many, or the origin is too far away.
        """
        if not abs(cell - self.cell) <= 1e-4:  # a NaN is rejected, too
            raise MapError(f"map: cells of {cell:g} m are not allowed, {self.cell:g} m (cell)")
        if not 1 <= values.size <= _MOST_GIVEN:
            raise MapError(f"map: {values.size} cells are not allowed, 1 to {_MOST_GIVEN}")
        if not (np.abs(origin) <= _FARTHEST_ORIGIN).all():
            text = ", ".join(f"{value:g}" for value in np.asarray(origin).tolist())
            raise MapError(f"map: origin ({text}) is not allowed, finite numbers within +-{_FARTHEST_ORIGIN:g} m")
        evidence = np.zeros(values.shape, np.int16)
        evidence[values >= _GIVEN_FROM] = MOST
        evidence[(values >= 0) & (values <= _GIVEN_FREE_TO)] = 2 * FREE_TO
        self._resize(np.rint(np.asarray(origin)[:2] / self.cell).astype(np.int64), evidence)

    def enter(self, origins: Array, ends: Array, hits: NDArray[np.bool_]) -> None:
        """Insert the rays of a scan; call ``update_distance`` afterwards.

        Args:
            origins, ends: (n, 2) or longer, m in map; beyond the map is allowed.
            hits: (n,) whether the ray ends at a surface.
        """
        middle = 0.5 * self.cell  # all rays run in the single layer
        rays = [np.column_stack([places[:, :2], np.full(len(places), middle)]) for places in (origins, ends)]
        cast_rays(self.evidence, self._touched, self.corner, self.cell, *rays, hits)
        np.copyto(self.evidence, self._given, where=self._given >= OCCUPIED_FROM)

    def forget_around(self, position: Array) -> None:
        """Clear observations in the local costmap around a position, (2,) or longer, m in map."""
        part = self.local(position)
        self.evidence[part] = self._given[part]
        self.update_distance()

    def forget_all(self) -> None:
        """Forget everything that was seen; a given map stays."""
        self.evidence[:] = self._given
        self.update_distance()

    def update_distance(self) -> None:
        """Compute all distances."""
        distance_field(self.evidence, OCCUPIED_FROM, self.cell, self.farthest, self.distance)

    def update_distance_around(self, position: Array) -> None:
        """Update the distances in the local costmap around a position, (2,) or longer, m in map."""
        inner, reach = self.local(position), math.ceil(self.farthest / self.cell)
        outer = tuple(slice(max(0, part.start - reach), part.stop + reach) for part in inner)
        evidence = np.ascontiguousarray(self.evidence[outer])
        distance = np.empty(evidence.shape, np.float32)
        distance_field(evidence, OCCUPIED_FROM, self.cell, self.farthest, distance)
        within = tuple(slice(a.start - b.start, a.stop - b.start) for a, b in zip(inner, outer, strict=True))
        self.distance[inner] = distance[within]

    def local(self, position: Array) -> tuple[slice, slice]:
        """Return which cells, along x and y, are in the local costmap around a position, (2,) or longer, m in map."""
        half = round(0.5 * self.settings.local_side / self.cell)
        i, j = self.index(position)
        nx, ny, _ = self.evidence.shape
        spans = [(min(max(k - half, 0), n), min(max(k + half, 0), n)) for k, n in ((i, nx), (j, ny))]
        return slice(*spans[0]), slice(*spans[1])

    def index(self, position: Array) -> tuple[int, int]:
        """Return the cell of a position, (2,) or longer, m in map; it may lie outside."""
        i, j = (np.floor(np.asarray(position)[:2] / self.cell).astype(np.int64) - self.corner[:2]).tolist()
        return i, j

    def is_inside(self, position: Array) -> bool:
        """Return whether a position, (2,) or longer, m in map, is on the map."""
        i, j = self.index(position)
        nx, ny, _ = self.evidence.shape
        return 0 <= i < nx and 0 <= j < ny

    def away(self, position: Array) -> float:
        """Return the distance of a position on the map to the nearest obstacle, m."""
        i, j = self.index(position)
        return float(self.distance[i, j, 0])

    def middle(self, cells: NDArray[np.int64]) -> Array:
        """Return the centres (n, 2) of cells, (n, 2) or longer, m in map."""
        return np.asarray((cells[:, :2] + self.corner[:2] + 0.5) * self.cell, float)

    def costs(self, part: tuple[slice, slice], radius: float) -> NDArray[np.int8]:
        """Return the costs of some cells, (nx, ny): 100, 99, 98 to 0 with the distance, -1 where unknown.

        Args:
            part: which cells.
            radius: Radius of the vehicle, m.
        """
        distance, evidence = self.distance[part][:, :, 0], self.evidence[part][:, :, 0]
        costs = np.floor(98.0 * np.exp(-_STEEPNESS * np.maximum(0.0, distance - radius))).astype(np.int8)
        costs[distance >= self.farthest] = 0
        costs[(evidence > FREE_TO) & (costs == 0)] = UNKNOWN
        costs[distance < radius] = INSCRIBED
        costs[evidence >= OCCUPIED_FROM] = LETHAL
        return costs


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
            time_step: Time step between two rays, s.
            limits: minimum and maximum range, m.
            yaw: Yaw of the lidar in base_link, rad.
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

    def place(self, poses: Array, spacing: float, mount: Array, slab: float) -> tuple[Array, Array, NDArray[np.bool_]]:
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
