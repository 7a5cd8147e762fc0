"""The local map of one vehicle: measurements in, free, occupied and unknown space and distances out."""

from __future__ import annotations

from xtdrone_perception.tracking.pose_history import PoseHistory
from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.ray_places import rays_in_map
from xtdrone_planning.mapping.voxel_grid import MapSettings, VoxelGrid


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
        """Forget map and poses, because simulated time was reset."""
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
        rays = rays_in_map(image, stamp_ns, mount, self.poses)
        if rays is None:
            return False
        self.grid.recentre(rays.position)
        self.grid.insert(rays.origins, rays.ends, rays.hits)
        self.grid.free_around(rays.position, self._radius)
        self.grid.update_distance()
        return True
