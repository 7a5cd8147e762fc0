"""Local map of one vehicle: turns range measurements into free, occupied and unknown space, and distances to
obstacles."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from xtdrone_perception.tracking.pose_history import PoseHistory
from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.ray_places import leave_out_places, rays_in_map
from xtdrone_planning.mapping.voxel_grid import MapSettings, VoxelGrid

Array = NDArray[np.float64]


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
            settings: of the grid.
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
