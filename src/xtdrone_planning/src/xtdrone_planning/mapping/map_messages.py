"""Conversion of maps to ROS messages."""

from __future__ import annotations

import math

import numpy as np
import rospy
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray

from xtdrone_planning.mapping.voxel_grid import FREE_TO, OCCUPIED_FROM, VoxelGrid

FRAME = "map"


def grid_message(
    cells: NDArray[np.int8], corner: tuple[float, float, float], cell: float, stamp: rospy.Time, frame: str = FRAME
) -> OccupancyGrid:
    """Return a plane map as a message.

    Args:
        cells: (nx, ny) percent of occupation, -1 unknown.
        corner: Lowest corner of the lowest cell, x, y, z, m in the frame.
        cell: Side of a cell, m.
        stamp: Time of the map.
        frame: Name of its frame.
    """
    message = OccupancyGrid()
    message.header.stamp, message.header.frame_id = stamp, frame
    message.info.map_load_time, message.info.resolution = stamp, cell
    message.info.width, message.info.height = cells.shape
    origin = message.info.origin
    origin.position.x, origin.position.y, origin.position.z = corner
    origin.orientation.w = 1.0
    message.data = cells.T.ravel().tolist()
    return message


def slice_at(grid: VoxelGrid, height: float, stamp: rospy.Time) -> OccupancyGrid:
    """Return the layer of the map at a height, m: 0 free, 100 occupied, -1 unknown."""
    layer = int(np.clip(math.floor(height / grid.resolution) - grid.corner[2], 0, grid.evidence.shape[2] - 1))
    evidence = grid.evidence[:, :, layer]
    values = np.full(evidence.shape, -1, np.int8)
    values[evidence <= FREE_TO] = 0
    values[evidence >= OCCUPIED_FROM] = 100
    x, y = grid.origin[:2].tolist()
    return grid_message(values, (x, y, float((layer + grid.corner[2] + 0.5) * grid.resolution)), grid.resolution, stamp)
