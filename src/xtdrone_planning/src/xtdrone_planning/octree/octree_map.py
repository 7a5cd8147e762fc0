"""Global map: all observed voxels with their log-odds of occupancy, in bounded memory.

Log-odds and their defaults are those of octomap (A. Hornung et al., OctoMap: an efficient probabilistic 3D mapping
framework based on octrees, Autonomous Robots 34, 2013, equations 2 to 4; hit 0.7, miss 0.4, clamped to 0.12 and 0.97).
In memory the voxels form blocks of 16 x 16 x 16, into which rays are inserted faster than into octree nodes;
``octree_format`` converts them to the octree.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.pose_history import PoseHistory
from xtdrone_common.settings import Settings, setting
from xtdrone_planning.mapping.range_images import RangeImage
from xtdrone_planning.mapping.ray_places import rays_in_map
from xtdrone_planning.octree.octree_kernels import HALF, OFFSET, SIDE, UNKNOWN, VOXELS, enter_rays

Array = NDArray[np.float64]

_BYTES = VOXELS * 3  # of a block: log-odds, and marks of the current measurement
_BLOCK_BITS = 12  # of a block's index along an axis


@dataclass(frozen=True)
class OctreeSettings(Settings):
    """Voxels of the global map, and its memory."""

    resolution: float = setting(0.2, low=0.02, high=2.0, unit="m", text="voxel size")
    hit: float = setting(0.7, low=0.5, high=0.999, text="probability that a voxel in which a ray ends is occupied")
    miss: float = setting(
        0.4, low=0.001, high=0.5, text="probability that a voxel through which a ray passes is occupied"
    )
    least: float = setting(0.12, low=0.01, high=0.49, text="minimum occupancy probability of a voxel")
    most: float = setting(0.97, low=0.51, high=0.99, text="maximum occupancy probability of a voxel")
    memory: float = setting(512.0, low=1.0, high=16384.0, unit="MB", text="maximum memory of the map")


def log_odds(probability: float) -> int:
    """Return the log-odds of a probability, in hundredths."""
    return round(100.0 * math.log(probability / (1.0 - probability)))


class OctreeMap:
    """The global map.

    Attributes:
        resolution: side of a voxel, m.
    """

    def __init__(self, settings: OctreeSettings) -> None:
        """Start with an empty map."""
        self.settings = settings
        self.resolution = settings.resolution
        self._change = np.array([log_odds(p) for p in (settings.hit, settings.miss, settings.least, settings.most)])
        self._capacity = max(1, int(settings.memory * 1e6 / _BYTES))
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        capacity = self._capacity
        self._table = np.full(1 << (2 * capacity - 1).bit_length(), -1, np.int64)
        self._keys = np.zeros(capacity, np.int64)
        self._counts = np.zeros(2, np.int64)
        self._voxels = np.zeros((capacity, VOXELS), np.uint16)  # the system allocates memory on the first write
        self._seen = np.zeros((capacity, VOXELS), np.uint8)
        self._touched = np.zeros(capacity, np.int64)
        self._touched_at = np.zeros(capacity, np.bool_)

    @property
    def memory(self) -> float:
        """Memory in use, MB."""
        return float(self._counts[0]) * _BYTES / 1e6

    @property
    def is_full(self) -> bool:
        """Whether voxels were dropped because memory was full."""
        return bool(self._counts[1])

    def insert(self, origins: Array, ends: Array, hits: NDArray[np.bool_]) -> None:
        """Insert the rays of one measurement; voxels for which there is no memory are dropped.

        Args:
            origins: (n, 3) where the rays begin, m in map.
            ends: (n, 3) where they end.
            hits: (n,) whether the ray ends at a surface; otherwise it is free to its end.
        """
        enter_rays(
            self._table, self._keys, self._counts, self._voxels, self._seen, self._touched, self._touched_at,
            self._change, self.resolution, np.ascontiguousarray(origins, float), np.ascontiguousarray(ends, float),
            np.ascontiguousarray(hits, np.bool_),
        )  # fmt: skip

    def blocks(self) -> tuple[NDArray[np.int64], NDArray[np.int16]]:
        """Return the blocks in the order of the octree's children.

        Returns:
            Copies: places (n, 3), in blocks from the octree's lowest corner, and log-odds (n, 4096) in hundredths, in
            Morton order, ``NEVER`` where nothing is known.
        """
        keys = self._keys[: self._counts[0]]
        mask = (1 << _BLOCK_BITS) - 1
        places = np.stack([keys & mask, keys >> _BLOCK_BITS & mask, keys >> 2 * _BLOCK_BITS], axis=1)
        order = np.argsort(morton(places), kind="stable")
        values = self._voxels[: self._counts[0]][order].view(np.int16)
        values -= OFFSET
        values[values == UNKNOWN - OFFSET] = NEVER
        return places[order], values

    def occupied(self) -> Array:
        """Return the centres of all occupied voxels, (n, 3) m in map."""
        return voxel_middles(*self.blocks(), self.resolution)


NEVER = np.int16(-(1 << 15))
"""Log-odds of an unknown voxel."""


def morton(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the Morton codes (n,) of places (n, 3) of at most 16 bits; x is the lowest bit of each three."""
    codes = np.zeros(len(places), np.int64)
    for bit in range(16):
        for axis in range(3):
            codes |= (places[:, axis] >> bit & 1) << (3 * bit + axis)
    return codes


def in_block() -> NDArray[np.int64]:
    """Return the places (4096, 3) of a block's voxels, in Morton order."""
    numbers = np.arange(VOXELS)
    return np.stack([sum((numbers >> (3 * b + a) & 1) << b for b in range(4)) for a in range(3)], axis=1)


def blocks_of(points: Array, resolution: float) -> tuple[NDArray[np.int64], NDArray[np.int16]]:
    """Return blocks in which the voxels of some points are occupied, and all others unknown; see ``OctreeMap.blocks``.

    Args:
        points: (n, 3) m in map; those beyond the octree's 65536 voxels along an axis are left out.
        resolution: side of a voxel, m.
    """
    cells = np.floor(points / resolution).astype(np.int64) + HALF
    cells = cells[((cells >= 0) & (cells < 2 * HALF)).all(axis=1)]
    numbers, owner = np.unique(morton(cells // SIDE), return_inverse=True)
    places = np.zeros((len(numbers), 3), np.int64)
    places[owner] = cells // SIDE
    values = np.full((len(numbers), VOXELS), NEVER, np.int16)
    values[owner, morton(cells % SIDE)] = log_odds(OctreeSettings().most)
    return places, values


def voxel_middles(places: NDArray[np.int64], values: NDArray[np.int16], resolution: float) -> Array:
    """Return the centres of the occupied voxels (log-odds of at least 0) of some blocks, (n, 3) m in map.

    Args:
        places: (m, 3) of the blocks; see ``OctreeMap.blocks``.
        values: (m, 4096) log-odds.
        resolution: side of a voxel, m.
    """
    block, voxel = np.nonzero(values >= 0)
    cells = SIDE * places[block] + in_block()[voxel] - HALF
    return np.asarray((cells + 0.5) * resolution, float)


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
