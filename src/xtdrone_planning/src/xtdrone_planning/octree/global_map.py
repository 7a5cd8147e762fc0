"""Octree of one vehicle: inserts each measurement as soon as the poses at its time are known."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from xtdrone_control.pose_history import PoseHistory
from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.ray_places import rays_in_map
from xtdrone_planning.octree.octree_map import OctreeMap, OctreeSettings

_REACH = 0.002  # s: maximum time between a pose and a ray
_ROUNDING_NS = 1_000_000  # tolerance of stamps relative to multiples of the interval
_WAITING = 5  # measurements that wait for their poses; odometry is published after the scan that it comes from


class _Waiting(NamedTuple):
    image: RangeImage
    stamp_ns: int
    mount: tuple[float, float, float]


class GlobalMap:
    """Inserts range images into an octree.

    Attributes:
        octree: the map.
        poses: history of base_link poses: x, y, z, m in map, and quaternion w, x, y, z; ``poses.add`` appends one.
        entered: number of measurements in the map.
        left_out: number of measurements dropped because their poses did not arrive in time.
    """

    def __init__(self, settings: OctreeSettings, interval: float = 0.0) -> None:
        """Start empty.

        Args:
            settings: Settings of the octree.
            interval: minimum time between two mapped measurements, s; others are skipped.
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
        """Queue a measurement until ``update`` knows its poses; see ``LocalMap.enter``."""
        if self._last_ns is not None and stamp_ns - self._last_ns < self._interval_ns - _ROUNDING_NS:
            return True
        self._last_ns = stamp_ns
        self._waiting.append(_Waiting(image, stamp_ns, mount))
        if len(self._waiting) > _WAITING:
            self._waiting.popleft()
            self.left_out += 1
        return True

    def update(self) -> None:
        """Insert the measurements whose poses are known by now."""
        for _ in range(len(self._waiting)):
            waiting = self._waiting.popleft()
            rays = rays_in_map(*waiting, self.poses)
            if rays is None:
                self._waiting.append(waiting)
                continue
            self.octree.insert(rays.origins, rays.ends, rays.hits)
            self.entered += 1
