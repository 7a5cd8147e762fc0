"""Content of a message in a layer, in the message's frame: positions of points or of a line, or the cells of a grid.

Everything is checked here, before it is converted, and reduced to numbers that a browser draws without a GPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from xtdrone_common.clouds import read_cloud, read_scan

MOST_POSES = 100_000  # of a path that is read
MOST_CORNERS = 1000  # of a line that is sent
MOST_CELLS = 4_000_000  # of a grid that is read
MOST_SIDE = 512  # cells along a side of a grid that is sent
FARTHEST = 1e5  # m, of a place from the origin of its frame
UNKNOWN = 255
"""Value of an unknown cell."""
_GOLDEN = 0.6180339887498949  # multiples of it, modulo 1, fill the interval evenly

Array = NDArray[np.float64]


class LayerError(ValueError):
    """A message that cannot be shown; the text names the field, its value and what is allowed."""


class Points(NamedTuple):
    """Points of a cloud or scan.

    Attributes:
        places: (n, 3) m in the message's frame, finite.
        total: points of the message.
    """

    places: Array
    total: int


class Line(NamedTuple):
    """Corners of a path: as of ``Points``."""

    places: Array
    total: int


class Grid(NamedTuple):
    """Cells of a map.

    Attributes:
        cells: (rows, columns) 0 free to 100 occupied, 255 unknown; the first is at the origin, columns go along x.
        side: of a cell, m.
        position: (3,) of the origin, m in the message's frame.
        orientation: (4,) of the grid, unit quaternion w, x, y, z.
    """

    cells: NDArray[np.uint8]
    side: float
    position: Array
    orientation: Array


Content = Points | Line | Grid


def content_of(kind: str, message: Any, most: int) -> Content:
    """Return the content of a message.

    Args:
        kind: its type, one of ``TYPES``.
        message: of that type.
        most: points of a cloud or scan.

    Raises:
        LayerError: the message is not allowed.
    """
    try:
        return _READERS[kind](message, most)
    except LayerError:
        raise
    except ValueError as error:
        raise LayerError(str(error)) from error


def _cloud(message: Any, most: int) -> Points:
    if message.height > 1 and message.row_step != message.width * message.point_step:
        raise LayerError(
            f"row_step: {message.row_step} is not allowed, {message.width * message.point_step} for {message.width} "
            f"points of {message.point_step} bytes"
        )
    return _thinned(read_cloud(message).points, most)


def _scan(message: Any, most: int) -> Points:
    flat = read_scan(message).points
    return _thinned(np.column_stack([flat, np.zeros(len(flat))]), most)


def _thinned(points: Array, most: int) -> Points:
    """Return at most about ``most`` of the points, evenly over their order; not every n-th, as lidars repeat."""
    near = points[(np.abs(points) <= FARTHEST).all(axis=1)]
    if len(near) > most:
        near = near[(np.arange(len(near)) * _GOLDEN) % 1.0 < most / len(near)]
    return Points(near, len(points))


def _path(message: Any, _most: int) -> Line:
    count = len(message.poses)
    if count > MOST_POSES:
        raise LayerError(f"poses: {count} are not allowed, at most {MOST_POSES}")
    every = max(1, math.ceil(count / MOST_CORNERS))
    chosen = [*message.poses[:-1:every], *message.poses[-1:]]
    places = np.array([(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in chosen], float).reshape(-1, 3)
    wrong = ~(np.abs(places) <= FARTHEST).all(axis=1)
    if wrong.any():
        raise LayerError(f"poses: {places[wrong][0].tolist()} is not allowed, finite and within {FARTHEST:g} m")
    return Line(places, count)


def _grid(message: Any, _most: int) -> Grid:
    info = message.info
    if not 0 < info.width * info.height == len(message.data) <= MOST_CELLS:
        raise LayerError(
            f"data: {len(message.data)} cells are not allowed, width * height, {info.width} * {info.height}, "
            f"1 to {MOST_CELLS}"
        )
    place, turn = info.origin.position, info.origin.orientation
    position, orientation = np.array([place.x, place.y, place.z]), np.array([turn.w, turn.x, turn.y, turn.z])
    if not (0.0 < info.resolution <= FARTHEST and np.abs(position).max() <= FARTHEST):
        raise LayerError(
            f"info: resolution {info.resolution:g} m at {position.tolist()} is not allowed, above 0 and within "
            f"{FARTHEST:g} m"
        )
    norm = float(np.linalg.norm(orientation))
    if norm == 0.0:  # as many publishers leave it
        orientation, norm = np.array([1.0, 0.0, 0.0, 0.0]), 1.0
    if not math.isfinite(norm):
        raise LayerError(f"info.origin.orientation: {orientation.tolist()} is not allowed, finite")
    cells = np.frombuffer(np.asarray(message.data, np.int8), np.uint8).reshape(info.height, info.width)
    merged, factor = _merged(np.where(cells > 100, UNKNOWN, cells).astype(np.uint8))
    return Grid(merged, info.resolution * factor, position, orientation / norm)


def _merged(cells: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], int]:
    """Return cells merged to at most ``MOST_SIDE`` along a side, and the number merged along a side.

    The most occupied of the merged cells counts, and known cells take precedence over unknown ones.
    """
    factor = math.ceil(max(cells.shape) / MOST_SIDE)
    if factor == 1:
        return cells, 1
    rows, columns = (np.arange(0, length, factor) for length in cells.shape)
    ranked = cells + np.uint8(1)  # unknown, 255, becomes 0
    most = np.maximum.reduceat(np.maximum.reduceat(ranked, rows, axis=0), columns, axis=1)
    return most - np.uint8(1), factor


_READERS: Mapping[str, Callable[[Any, int], Content]] = {
    "nav_msgs/Path": _path,
    "sensor_msgs/PointCloud2": _cloud,
    "sensor_msgs/LaserScan": _scan,
    "nav_msgs/OccupancyGrid": _grid,
}
TYPES = tuple(_READERS)
