"""Conversion of ROS messages to clouds and images, and of the map to messages."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import rospy
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from sensor_msgs.msg import Image, PointCloud2, PointField

from xtdrone_planning.mapping.range_images import ScanError
from xtdrone_planning.mapping.voxel_grid import FREE_TO, OCCUPIED_FROM, VoxelGrid

FRAME = "map"

_XYZ = [PointField(name, 4 * n, PointField.FLOAT32, 1) for n, name in enumerate("xyz")]
_DEPTHS: dict[str, tuple[np.dtype[Any], float]] = {"32FC1": (np.dtype("<f4"), 1.0), "16UC1": (np.dtype("<u2"), 0.001)}
"""Encodings of depth images (REP 118): type, and metres per unit."""


def depths_of(message: Image) -> NDArray[np.float64]:
    """Return the depths (height, width), m, of an image; NaN or infinite where there is no value.

    Raises:
        ScanError: the encoding or size is not that of a depth image.
    """
    if message.encoding not in _DEPTHS or message.is_bigendian:
        raise ScanError(f"encoding: {message.encoding!r} is not allowed, 32FC1 or 16UC1, little-endian")
    kind, unit = _DEPTHS[message.encoding]
    needed = message.width * kind.itemsize
    if message.width == 0 or message.step < needed or len(message.data) != message.step * message.height:
        raise ScanError(
            f"data: {len(message.data)} bytes for {message.width} x {message.height} pixels, step {message.step}, "
            "are not allowed, step * height"
        )
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)[:, :needed]
    depths = np.ascontiguousarray(rows).view(kind).astype(float) * unit
    if kind.kind == "u":
        depths[depths == 0.0] = math.nan
    return depths


def occupied_cloud(grid: VoxelGrid, stamp: rospy.Time) -> PointCloud2:
    """Return the centres of the occupied voxels as a cloud."""
    points = grid.occupied().astype("<f4")
    message = PointCloud2(height=1, width=len(points), fields=_XYZ, point_step=12, is_dense=True)
    message.header.stamp, message.header.frame_id = stamp, FRAME
    message.row_step, message.data = 12 * len(points), points.tobytes()
    return message


def slice_at(grid: VoxelGrid, height: float, stamp: rospy.Time) -> OccupancyGrid:
    """Return the layer of the map at a height, m: 0 free, 100 occupied, -1 unknown."""
    layer = int(np.clip(math.floor(height / grid.resolution) - grid.corner[2], 0, grid.evidence.shape[2] - 1))
    evidence = grid.evidence[:, :, layer].T
    values = np.full(evidence.shape, -1, np.int8)
    values[evidence <= FREE_TO] = 0
    values[evidence >= OCCUPIED_FROM] = 100
    message = OccupancyGrid()
    message.header.stamp, message.header.frame_id = stamp, FRAME
    message.info.map_load_time = stamp
    message.info.resolution = grid.resolution
    message.info.width, message.info.height = values.shape[1], values.shape[0]
    origin = message.info.origin
    origin.position.x, origin.position.y = grid.origin[:2].tolist()
    origin.position.z = float((layer + grid.corner[2] + 0.5) * grid.resolution)
    origin.orientation.w = 1.0
    message.data = values.ravel().tolist()
    return message
