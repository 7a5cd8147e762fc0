"""Conversion of the octree to ROS messages: octomap_msgs, centres of occupied voxels, and the projected map."""

from __future__ import annotations

import numpy as np
import rospy
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from octomap_msgs.msg import Octomap
from sensor_msgs.msg import PointCloud2

from xtdrone_common.clouds import cloud_message
from xtdrone_planning.mapping.map_messages import grid_message
from xtdrone_planning.octree.octree_format import Octree, OctreeError, count_nodes
from xtdrone_planning.octree.octree_kernels import HALF, SIDE
from xtdrone_planning.octree.octree_map import NEVER, in_block, voxel_middles

MOST_CELLS = 4_000_000
"""Of the map seen from above."""

_ID = "OcTree"


def octomap_message(octree: Octree, stamp: rospy.Time, frame: str) -> Octomap:
    """Return a serialised octree as a message."""
    message = Octomap(binary=octree.binary, id=_ID, resolution=octree.resolution)
    message.header.stamp, message.header.frame_id = stamp, frame
    message.data = np.frombuffer(octree.data, np.int8).tolist()
    return message


def octree_of(message: Octomap) -> Octree:
    """Return the serialised octree of a message.

    Raises:
        OctreeError: it is of another kind, e.g. a ColorOcTree, whose nodes have other data.
    """
    if message.id != _ID:
        raise OctreeError(f"id {message.id!r} is not allowed, {_ID}")
    data = np.asarray(message.data, np.int8).tobytes()
    binary = bool(message.binary)
    return Octree(data, count_nodes(data, binary), float(message.resolution), binary)


def occupied_message(
    places: NDArray[np.int64], values: NDArray[np.int16], resolution: float, stamp: rospy.Time, frame: str
) -> PointCloud2:
    """Return the centres of the occupied voxels of some blocks; see ``octree_map.voxel_middles``."""
    return cloud_message(voxel_middles(places, values, resolution), stamp, frame)


def seen_from_above(
    places: NDArray[np.int64], values: NDArray[np.int16], resolution: float, heights: tuple[float, float]
) -> tuple[NDArray[np.int8], tuple[int, int]]:
    """Return the map between two heights, seen from above.

    Args:
        places: (n, 3) of the blocks; see ``OctreeMap.blocks``.
        values: (n, 4096) log-odds.
        resolution: side of a voxel, m.
        heights: minimum and maximum height of voxel centres that count, m.

    Returns:
        Cells (ny, nx): 100 with an occupied voxel, 0 with free voxels only, -1 unknown; and x and y of the first cell,
        in voxels from the origin. No cells if the map is empty or larger than ``MOST_CELLS``.
    """
    if not len(places):
        return np.zeros((0, 0), np.int8), (0, 0)
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0) + 1
    shape = tuple(int(n) for n in (high - low) * SIDE)
    if shape[0] * shape[1] > MOST_CELLS:
        return np.zeros((0, 0), np.int8), (0, 0)
    cells = np.full(shape, -1, np.int8)
    voxels = in_block()
    middles = (SIDE * places[:, 2, None] + voxels[:, 2] - HALF + 0.5) * resolution
    counts = (middles >= heights[0]) & (middles <= heights[1])
    for value, chosen in ((0, (values < 0) & (values != NEVER)), (100, values >= 0)):
        block, voxel = np.nonzero(chosen & counts)
        cells[tuple((SIDE * (places[block, :2] - low) + voxels[voxel, :2]).T)] = value
    first = SIDE * low - HALF
    return cells.T, (int(first[0]), int(first[1]))


def above_message(
    cells: NDArray[np.int8], first: tuple[int, int], resolution: float, stamp: rospy.Time, frame: str
) -> OccupancyGrid:
    """Return the map seen from above; see ``seen_from_above``."""
    return grid_message(cells.T, (first[0] * resolution, first[1] * resolution, 0.0), resolution, stamp, frame)
