"""The local map of one vehicle: measurements in, free, occupied and unknown space and distances out."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from xtdrone_perception.tracking.pose_history import PoseHistory
from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.ray_places import place_rays
from xtdrone_planning.mapping.voxel_grid import MapSettings, VoxelGrid

Array = NDArray[np.float64]

_PIECES = 6  # of a scan's time, between which the vehicle's pose is interpolated


class LocalMap:
    """Enters range images into a grid, each ray from where the vehicle was at the ray's time.

    Attributes:
        grid: the map.
        poses: of base_link, entries x, y, z, m in map, and quaternion w, x, y, z; ``poses.add`` adds the latest.
    """

    def __init__(self, settings: MapSettings, radius: float) -> None:
        """Start empty.

        Args:
            settings: of the grid.
            radius: m around the vehicle that are free because it is there.
        """
        self.grid = VoxelGrid(settings)
        self.poses = PoseHistory(seconds=2.0, reach=0.1)
        self._radius = radius

    def restart(self) -> None:
        """Forget map and poses, as simulated time was set back."""
        self.grid.clear()
        self.poses.clear()

    def enter(self, image: RangeImage, stamp_ns: int, mount: tuple[float, float, float]) -> bool:
        """Enter a measurement, and compute the distances.

        Args:
            image: the rays.
            stamp_ns: time of the image, ns.
            mount: the sensor's place in base_link, m, FLU.

        Returns:
            False if the pose at that time is not known; nothing has changed then.
        """
        ranges, directions, times, hits = image.rays()
        poses, spacing = self._poses(stamp_ns, float(times.max()) if len(times) else 0.0)
        if poses is None:
            return False
        origins, ends = np.empty_like(directions), np.empty_like(directions)
        place_rays(poses, spacing, np.array(mount), ranges, directions, times, origins, ends)
        self.grid.recentre(poses[-1, :3])
        self.grid.insert(origins, ends, hits)
        self.grid.free_around(poses[-1, :3], self._radius)
        self.grid.update_distance()
        return True

    def _poses(self, stamp_ns: int, seconds: float) -> tuple[Array | None, float]:
        """Return the poses at times evenly spaced over a scan, (m, 7), and their spacing, s."""
        spacing = max(seconds, 1e-3) / _PIECES
        found = [self.poses.at(stamp_ns + round(k * spacing * 1e9)) for k in range(_PIECES + 1)]
        poses = [pose.copy() for pose in found if pose is not None]
        if len(poses) < len(found):
            return None, spacing
        for before, after in itertools.pairwise(poses):
            if before[3:] @ after[3:] < 0.0:
                after[3:] *= -1.0  # a quaternion and its negative are the same rotation: use the nearer one
        return np.array(poses), spacing
