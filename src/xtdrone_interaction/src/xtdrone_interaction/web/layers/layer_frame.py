"""The binary frame of a layer, channel 3: points, a line or a grid in the map frame.

Little-endian; offsets in bytes, of the whole frame with its first byte:

======  ==========  ==========================================================================
offset  type        value
======  ==========  ==========================================================================
0       uint8       3, the channel
1       uint8       1, the version of this layout
2       uint8       1 points, 2 line, 3 grid
3       uint8       0
4       uint32      number of the subscription
8       float64     time of the message, s of ROS time
16      uint32      n, number of points, or columns of the grid
20      uint32      number of points of the message, or rows of the grid
24      3 float64   lowest x, y and z of the points, or origin of the grid, m ENU
48      3 float32   extent of the points along x, y and z, m; of the grid its cells' side, 0, 0
60      4 float32   orientation of the grid, quaternion w, x, y, z; of points 1, 0, 0, 0
76      uint32      0
80      n * 3       of points and lines: uint16 x, y, z in 1/65535 of the extent
        n * rows    of grids: uint8 cells, rows along x: 0 free to 100 occupied, 255 unknown
======  ==========  ==========================================================================

``web_page/layers/layer_frame.js`` reads it.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from xtdrone_common.pose_matrices import pose_of, quaternion_of, rotation_of, transform_points
from xtdrone_interaction.web.layers.layer_content import Content, Grid, Line

CHANNEL = 3
_VERSION = 1
_HEAD = struct.Struct("<BBBI")  # after the channel
_BODY = struct.Struct("<dII3d3f4fI")
_POINTS, _LINE, _GRID = 1, 2, 3
_STEPS = 65535
_LEAST_EXTENT = 1e-3  # m

Array = NDArray[np.float64]


def packed_layer(content: Content, pose: Array, time: float) -> bytes:
    """Return the part after the number of the subscription.

    Args:
        content: of a message.
        pose: (4, 4) of the message's frame in the map frame.
        time: of the message, s.
    """
    if isinstance(content, Grid):
        return _packed_grid(content, pose, time)
    places = transform_points(pose, content.places)
    lowest = places.min(axis=0) if len(places) else np.zeros(3)
    extent = np.maximum(np.ptp(places, axis=0) if len(places) else 0.0, _LEAST_EXTENT)
    steps = np.rint((places - lowest) * (_STEPS / extent)).astype("<u2")
    body = _BODY.pack(time, len(places), content.total, *lowest, *np.broadcast_to(extent, 3), 1.0, 0.0, 0.0, 0.0, 0)
    return body + steps.tobytes()


def _packed_grid(grid: Grid, pose: Array, time: float) -> bytes:
    (rows, columns), side = grid.cells.shape, grid.side
    (position,) = transform_points(pose, grid.position[None])
    w, x, y, z = grid.orientation
    turned = pose_of(position, rotation_of(pose) * Rotation.from_quat((x, y, z, w)))
    return _BODY.pack(time, columns, rows, *position, side, 0.0, 0.0, *quaternion_of(turned), 0) + grid.cells.tobytes()


def pack_layer(number: int, content: Content, packed: bytes) -> bytes:
    """Return a frame without its first byte, which the session adds.

    Args:
        number: of the subscription.
        content: of the message.
        packed: by ``packed_layer``, once for all pages.
    """
    kind = _GRID if isinstance(content, Grid) else _LINE if isinstance(content, Line) else _POINTS
    return _HEAD.pack(_VERSION, kind, 0, number) + packed
