"""The octree of one vehicle: measurements in, each from the poses of its time, as soon as these are known."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from xtdrone_perception.tracking.pose_history import PoseHistory
from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.ray_places import rays_in_map
from xtdrone_planning.octree.octree_map import OctreeMap, OctreeSettings

_REACH = 0.002  # s by which a pose may be off the time of a ray
_ROUNDING_NS = 1_000_000  # by which stamps may be off a multiple of the interval
_WAITING = 5  # measurements that wait for their poses; odometry is published after the scan that it is from


class _Waiting(NamedTuple):
    image: RangeImage
    stamp_ns: int
    mount: tuple[float, float, float]


class GlobalMap:
    """Enters range images into an octree.

    Attributes:
        octree: the map.
        poses: of base_link, entries x, y, z, m in map, and quaternion w, x, y, z; ``poses.add`` adds the latest.
        entered: number of measurements in the map.
        left_out: number of measurements that were dropped, as their poses were not known in time.
    """

    def __init__(self, settings: OctreeSettings, interval: float = 0.0) -> None:
        """Start empty.

        Args:
            settings: of the octree.
            interval: s; a measurement that follows the last one sooner is left out.
        """
        self._interval_ns = round(interval * 1e9)
        self.octree = OctreeMap(settings)
        self.poses = PoseHistory(seconds=5.0, reach=_REACH)
        self.restart()

    def restart(self) -> None:
        """Forget map and poses, because simulated time was reset."""
        self.octree.clear()
        self.poses.clear()
        self._waiting: deque[_Waiting] = deque()
        self._last_ns: int | None = None
        self.entered = self.left_out = 0

    def enter(self, image: RangeImage, stamp_ns: int, mount: tuple[float, float, float]) -> bool:
        """Keep a measurement until ``update`` knows its poses; see ``LocalMap.enter``."""
        if self._last_ns is not None and stamp_ns - self._last_ns < self._interval_ns - _ROUNDING_NS:
            return True
        self._last_ns = stamp_ns
        self._waiting.append(_Waiting(image, stamp_ns, mount))
        if len(self._waiting) > _WAITING:
            self._waiting.popleft()
            self.left_out += 1
        return True

    def update(self) -> None:
        """Enter the measurements whose poses are known by now."""
        for _ in range(len(self._waiting)):
            waiting = self._waiting.popleft()
            rays = rays_in_map(*waiting, self.poses)
            if rays is None:
                self._waiting.append(waiting)
                continue
            self.octree.insert(rays.origins, rays.ends, rays.hits)
            self.entered += 1
