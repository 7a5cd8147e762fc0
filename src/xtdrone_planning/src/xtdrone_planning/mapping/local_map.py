"""Local map of one vehicle: turns range measurements into free, occupied and unknown space, and distances to
obstacles."""

from __future__ import annotations

from xtdrone_perception.tracking.pose_history import PoseHistory
from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.ray_places import rays_in_map
from xtdrone_planning.mapping.voxel_grid import MapSettings, VoxelGrid


class LocalMap:
    """Inserts range images into a grid; each ray starts at the vehicle's pose at the time of the ray.

    Attributes:
        grid: the map.
        poses: history of base_link poses: x, y, z, m in map, and quaternion w, x, y, z; ``poses.add`` appends one.
    """

    def __init__(self, settings: MapSettings, radius: float) -> None:
        """Start empty.

        Args:
            settings: of the grid.
            radius: space within this distance of the vehicle counts as free, m.
        """
        self.grid = VoxelGrid(settings)
        self.poses = PoseHistory(seconds=2.0, reach=0.1)
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
        self.grid.insert(rays.origins, rays.ends, rays.hits)
        self.grid.free_around(rays.position, self._radius)
        self.grid.update_distance()
        return True
