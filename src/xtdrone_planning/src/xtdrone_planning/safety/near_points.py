"""Relevant points of a cloud: the nearest one in each direction."""

from __future__ import annotations

import math

import numpy as np

from xtdrone_common.rotation_kernels import rotate
from xtdrone_planning.kernel import kernel

_AZIMUTHS, _HEIGHTS = 32, 16
SECTORS = _AZIMUTHS * _HEIGHTS
_OWN_BODY = 0.3  # m; closer points belong to the vehicle itself


@kernel
def place_points(points, mount, mount_attitude, position, attitude, reach):
    """Return the points within reach of the vehicle, in the local frame (ENU), shape (K, 3), m.

    Args:
        points: Points in the sensor's frame, shape (N, 3), m; not finite: no return.
        mount: Mount of the sensor in the body frame (FLU), shape (3,), m.
        mount_attitude: sensor to FLU, (w, x, y, z).
        position: Position of the vehicle at the time of measurement, ENU, shape (3,), m.
        attitude: FLU to ENU, (w, x, y, z).
        reach: m.
    """
    kept = np.empty((len(points), 3))
    count = 0
    for k in range(len(points)):
        x, y, z = rotate(mount_attitude, float(points[k, 0]), float(points[k, 1]), float(points[k, 2]))
        x, y, z = x + mount[0], y + mount[1], z + mount[2]
        square = x * x + y * y + z * z
        if _OWN_BODY * _OWN_BODY < square <= reach * reach:  # False for NaN
            x, y, z = rotate(attitude, x, y, z)
            kept[count, 0], kept[count, 1], kept[count, 2] = x + position[0], y + position[1], z + position[2]
            count += 1
    return kept[:count].copy()


@kernel
def without_vehicles(points, places, reach):
    """Return the points that are not at known vehicles, shape (K, 3), m.

    Args:
        points: shape (N, 3), m.
        places: Places of the vehicles, shape (M, 3), m; NaN: unknown.
        reach: distance from a vehicle's centre up to which a point may be of the vehicle, m.
    """
    kept = np.empty((len(points), 3))
    count = 0
    for k in range(len(points)):
        is_other = False
        for n in range(len(places)):
            x, y, z = points[k, 0] - places[n, 0], points[k, 1] - places[n, 1], points[k, 2] - places[n, 2]
            is_other = is_other or x * x + y * y + z * z < reach * reach  # False for NaN
        if not is_other:
            kept[count] = points[k]
            count += 1
    return kept[:count].copy()


@kernel
def nearest_by_sector(points, position, reach, near):
    """Store the nearest point in each sector of directions around a position; return their number.

    Sectors are uniform in azimuth and in the sine of the elevation.

    Args:
        points: shape (N, 3), m; those that are not finite are skipped.
        position: shape (3,), m.
        reach: m.
        near: shape (SECTORS, 3); written.
    """
    least = np.full(SECTORS, reach * reach)
    best = np.full(SECTORS, -1)
    for k in range(len(points)):
        x, y, z = points[k, 0] - position[0], points[k, 1] - position[1], points[k, 2] - position[2]
        square = x * x + y * y + z * z
        if not 0.0 < square < reach * reach:  # also skips NaN, which has no sector
            continue
        column = min(int((math.atan2(y, x) / (2.0 * math.pi) + 0.5) * _AZIMUTHS), _AZIMUTHS - 1)
        row = min(int((z / math.sqrt(square) * 0.5 + 0.5) * _HEIGHTS), _HEIGHTS - 1)
        sector = column * _HEIGHTS + row
        if square < least[sector]:
            least[sector] = square
            best[sector] = k
    count = 0
    for sector in range(SECTORS):
        if best[sector] >= 0:
            near[count] = points[best[sector]]
            count += 1
    return count
