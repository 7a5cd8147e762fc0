"""Messages of an exploration: encoding and decoding."""

from __future__ import annotations

import math

import numpy as np
import rospy
from geometry_msgs.msg import Point
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from xtdrone_msgs.msg import RegionShare

from xtdrone_common.clouds import points_of
from xtdrone_common.rotation import yaw_of
from xtdrone_planning.exploration.floor_map import FREE, OCCUPIED, OCCUPIED_FROM, UNKNOWN, Cells, FloorMap
from xtdrone_planning.exploration.shared_regions import Share
from xtdrone_planning.mapping.map_messages import grid_message

Array = NDArray[np.float64]

_MOST_REGIONS = 100_000
_MOST_CELLS = 8_000_000


class FloorError(ValueError):
    """A map or message that cannot be used; the text names the field, its value and what is allowed."""


def share_message(share: Share, height: float, stamp: rospy.Time, frame: str) -> RegionShare:
    """Return a message about regions; its positions get the height ``height``, m."""
    message = RegionShare(
        vehicle=share.vehicle, kind=share.kind, number=share.number, partner=share.partner, base=share.base,
        place=Point(*share.place, height), target=Point(*share.target, height),
        regions=sorted(share.regions), partner_regions=sorted(share.partner_regions),
    )  # fmt: skip
    message.header.stamp, message.header.frame_id = stamp, frame
    return message


def share_of(message: RegionShare, count: int) -> Share:
    """Decode a message.

    Args:
        message: Message of another vehicle.
        count: number of regions.

    Raises:
        FloorError: a region does not exist, a position is not finite, or the kind is unknown.
    """
    place, target = message.place, message.target
    if not all(map(math.isfinite, (place.x, place.y, target.x, target.y))):
        raise FloorError("place, target: numbers that are not finite are not allowed")
    if message.kind > RegionShare.REFUSAL:
        raise FloorError(f"kind: {message.kind} is not allowed, 0 to {RegionShare.REFUSAL}")
    sets = message.regions, message.partner_regions
    wrong = [region for regions in sets for region in regions[:_MOST_REGIONS] if not 0 <= region < count]
    if wrong:
        raise FloorError(f"regions: {wrong[0]} is not allowed, 0 to {count - 1}: the same bounds for all vehicles")
    return Share(
        message.vehicle, message.kind, message.number, message.partner, message.base,
        (place.x, place.y), (target.x, target.y), frozenset(message.regions), frozenset(message.partner_regions),
    )  # fmt: skip


def floor_message(floor: FloorMap, values: Cells, height: float, stamp: rospy.Time, frame: str) -> OccupancyGrid:
    """Return the cells ``values`` of a floor as a message."""
    x, y = (floor.first * floor.cell).tolist()
    return grid_message(values, (x, y, height), floor.cell, stamp, frame)


def cells_of(message: OccupancyGrid, cell: float) -> tuple[Array, float, Cells]:
    """Return origin, (2,) m in map, turn, rad, and cells (nx, ny) of a map.

    Args:
        message: the map; its origin's pose may be turned about z.
        cell: side that its cells must have, m.

    Raises:
        FloorError: other cells, a wrong number of them, or a pose that is not finite.
    """
    info = message.info
    if not math.isclose(info.resolution, cell, rel_tol=1e-3):
        raise FloorError(f"resolution: {info.resolution:g} is not allowed, {cell:g} m as here")
    if len(message.data) != info.width * info.height or not 0 < len(message.data) <= _MOST_CELLS:
        raise FloorError(f"data: {len(message.data)} cells are not allowed, width * height, {info.width * info.height}")
    place, turn = info.origin.position, info.origin.orientation
    if not all(map(math.isfinite, (place.x, place.y, turn.x, turn.y, turn.z, turn.w))):
        raise FloorError("origin: not finite")
    cells = np.array(message.data, np.int8).reshape(info.height, info.width).T
    return np.array([place.x, place.y]), yaw_of((turn.w, turn.x, turn.y, turn.z)), cells


def slice_of(slice_message: OccupancyGrid, occupied: PointCloud2, cell: float, near: float) -> tuple[Array, Cells]:
    """Return the floor cells that a local map covers.

    Args:
        slice_message: the layer at flight height: 0 free, 100 occupied, -1 unknown.
        occupied: centres of all occupied voxels of the same map.
        cell: side, m.
        near: m above and below the layer within which an occupied voxel marks its cell as occupied.

    Returns:
        The lowest corner, (2,) m in map, and the cells (nx, ny).

    Raises:
        FloorError: see ``cells_of``.
    """
    corner, _, layer = cells_of(slice_message, cell)
    cells = np.full(layer.shape, UNKNOWN, np.int8)
    cells[(layer >= 0) & (layer < OCCUPIED_FROM)] = FREE
    cells[layer >= OCCUPIED_FROM] = OCCUPIED
    points = points_of(occupied)
    places = np.stack([points["x"], points["y"], points["z"]], axis=1).astype(float)
    places = places[np.abs(places[:, 2] - slice_message.info.origin.position.z) <= near]
    numbers = np.floor((places[:, :2] - corner) / cell).astype(np.int64)
    numbers = numbers[np.all((numbers >= 0) & (numbers < cells.shape), axis=1)]
    cells[numbers[:, 0], numbers[:, 1]] = OCCUPIED
    return corner, cells
