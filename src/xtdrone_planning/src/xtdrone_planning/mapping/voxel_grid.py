"""The local map: a box of voxels that moves with the vehicle, each with the evidence that it is occupied.

``LocalMap`` inserts range measurements into a ``VoxelGrid``.

Evidence is a log-odds value in hundredths, clamped (A. Hornung et al., OctoMap: an efficient probabilistic 3D mapping
framework based on octrees, Autonomous Robots 34, 2013, equations 2 to 4). A voxel that no ray has reached has no
evidence: the third state, unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.pose_history import PoseHistory
from xtdrone_common.settings import Settings, setting
from xtdrone_planning.mapping.distance_field import distance_field
from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.ray_casting import cast_rays, free_sphere
from xtdrone_planning.mapping.ray_places import leave_out_places, rays_in_map

Array = NDArray[np.float64]

HIT, MISS = 85, -40
"""Evidence of a ray that ends in a voxel, and of one that passes through it."""
LEAST, MOST = -200, 350
OCCUPIED_FROM, FREE_TO = 50, -30
"""A voxel is occupied at or above the first value, free at or below the second, and unknown in between."""

_SLACK = 1.0  # m: offset of the vehicle from the centre of the box at which the box moves


@dataclass(frozen=True)
class MapSettings(Settings):
    """The local map."""

    resolution: float = setting(0.2, low=0.05, high=1.0, unit="m", text="voxel size")
    side: float = setting(24.0, low=4.0, high=80.0, unit="m", text="side of the map, along x and y")
    height: float = setting(4.8, low=1.0, high=40.0, unit="m", text="height of the map")
    farthest: float = setting(3.0, low=0.5, high=10.0, unit="m", text="distances to obstacles are computed up to this")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        across, up = (round(length / self.resolution) for length in (self.side, self.height))
        return across, across, up


class VoxelGrid:
    """The local map.

    Attributes:
        resolution: side of a voxel, m.
        evidence: (nx, ny, nz) int16, log-odds of occupation in hundredths.
        corner: (3,) index of the lowest voxel; voxel 0 begins at the origin of ``map``.
    """

    def __init__(self, settings: MapSettings) -> None:
        """Start with an unknown map around the origin."""
        self.settings = settings
        self.resolution = settings.resolution
        self.evidence = np.zeros(settings.shape, np.int16)
        self._distance = np.full(settings.shape, settings.farthest, np.float32)
        self._is_distance_old = False
        self.corner = -np.array(settings.shape, np.int64) // 2
        self._touched = np.zeros(self.evidence.size + 1, np.uint8)

    @property
    def origin(self) -> Array:
        """Lowest corner, (3,) m in map."""
        return np.asarray(self.corner * self.resolution, float)

    @property
    def upper(self) -> Array:
        """Highest corner, (3,) m in map."""
        return np.asarray((self.corner + self.evidence.shape) * self.resolution, float)

    def clear(self) -> None:
        """Forget everything."""
        self.evidence[:] = 0
        self._distance[:] = self.settings.farthest
        self._is_distance_old = False

    def recentre(self, position: Array) -> None:
        """Move the box, in whole voxels, so that ``position``, (3,) m in map, is near its middle.

        The distances are not those of the new place until ``update_distance``.
        """
        middle = 0.5 * (self.origin + self.upper)
        if np.all(np.abs(position - middle) <= _SLACK):
            return
        corner = np.floor(position / self.resolution).astype(np.int64) - np.array(self.evidence.shape) // 2
        moved = corner - self.corner
        self.evidence = _shift_values(self.evidence, moved)
        self.corner = corner

    def insert(self, origins: Array, ends: Array, hits: NDArray[np.bool_]) -> None:
        """Insert the rays of one measurement.

        Args:
            origins: (n, 3) where the rays begin, m in map.
            ends: (n, 3) where they end; beyond the box is allowed.
            hits: (n,) whether the ray ends at a surface; otherwise it is free to its end.
        """
        cast_rays(self.evidence, self._touched, self.corner, self.resolution, origins, ends, hits)

    def free_around(self, position: Array, radius: float) -> None:
        """Mark unknown voxels within ``radius`` m of the vehicle as free."""
        free_sphere(self.evidence, self.corner, self.resolution, np.asarray(position, float), radius)

    def update_distance(self) -> None:
        """Mark the distances as old: they are computed from the current evidence when they are read."""
        self._is_distance_old = True

    @property
    def distance(self) -> NDArray[np.float32]:
        """Distances (nx, ny, nz), m from a voxel's centre to that of the nearest occupied one.

        Read them between ``update_distance`` and the next change of the evidence.
        """
        if self._is_distance_old:
            distance_field(self.evidence, OCCUPIED_FROM, self.resolution, self.settings.farthest, self._distance)
            self._is_distance_old = False
        return self._distance

    def is_inside(self, point: Array) -> bool:
        """Return whether a point, (3,) m in map, is within the box."""
        return bool(np.all(point >= self.origin) and np.all(point < self.upper))

    def index(self, point: Array) -> tuple[int, int, int]:
        """Return the voxel of a point within the box, (3,) m in map."""
        i, j, k = (np.floor(np.asarray(point) / self.resolution).astype(np.int64) - self.corner).tolist()
        return i, j, k

    def middle(self, indices: NDArray[np.int64]) -> Array:
        """Return the centres of voxels (..., 3), m in map."""
        return np.asarray((indices + self.corner + 0.5) * self.resolution, float)

    def occupied(self) -> Array:
        """Return the centres of all occupied voxels, (n, 3) m in map."""
        return self.middle(np.argwhere(self.evidence >= OCCUPIED_FROM))


def _shift_values(values: NDArray[np.int16], moved: NDArray[np.int64]) -> NDArray[np.int16]:
    """Return a grid whose voxel i is the old one's voxel i + ``moved``; new voxels are 0."""
    shifted = np.zeros_like(values)
    old = [slice(max(0, m), n + min(0, m)) for m, n in zip(moved.tolist(), values.shape, strict=True)]
    new = [slice(max(0, -m), n + min(0, -m)) for m, n in zip(moved.tolist(), values.shape, strict=True)]
    if all(part.stop > part.start for part in old):
        shifted[tuple(new)] = values[tuple(old)]
    return shifted


def no_others(_: float) -> tuple[Array, Array]:
    """Return no vehicles; see ``LocalMap.others``."""
    return np.empty((0, 3)), np.empty(0)


class LocalMap:
    """Inserts range images into a grid; each ray starts at the vehicle's pose at the time of the ray.

    Attributes:
        grid: the map.
        poses: history of base_link poses: x, y, z, m in map, and quaternion w, x, y, z; ``poses.add`` appends one.
        others: returns positions of other vehicles at a time, s: (m, 3), and radii (m,), m, within which rays may end
            at the vehicle. Such rays are not inserted: a moving vehicle would leave a trail of obstacles.
        is_used: returns whether the distances are needed after each measurement; otherwise they are computed only when
            they are read.
    """

    def __init__(self, settings: MapSettings, radius: float) -> None:
        """Start empty.

        Args:
            settings: Settings of the grid.
            radius: space within this distance of the vehicle counts as free, m.
        """
        self.grid = VoxelGrid(settings)
        self.poses = PoseHistory(seconds=2.0, reach=0.1)
        self.others: Callable[[float], tuple[Array, Array]] = no_others
        self.is_used: Callable[[], bool] = lambda: True
        self._radius = radius

    def restart(self) -> None:
        """Forget map and poses, because simulated time was reset."""
        self.grid.clear()
        self.poses.clear()

    def enter(self, image: RangeImage, stamp_ns: int, mount: tuple[float, float, float]) -> bool:
        """Insert a measurement, and update the distances.

        Args:
            image: the rays.
            stamp_ns: time of the image, ns.
            mount: position of the sensor in base_link, m, FLU.

        Returns:
            False if the pose at that time is not known; the map is then unchanged.
        """
        rays = rays_in_map(image, stamp_ns, mount, self.poses, by_columns=True)
        if rays is None:
            return False
        self.grid.recentre(rays.position)
        middle = 1e-9 * stamp_ns + 0.5 * float(image.times.max(initial=0.0))
        count = leave_out_places(rays.origins, rays.ends, rays.hits, *self.others(middle))
        self.grid.insert(rays.origins[:count], rays.ends[:count], rays.hits[:count])
        self.grid.free_around(rays.position, self._radius)
        self.grid.update_distance()
        if self.is_used():
            _ = self.grid.distance
        return True
