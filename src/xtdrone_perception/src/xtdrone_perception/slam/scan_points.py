"""Conversion of lidar clouds to arrays."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_TIMES = ("time", "t", "timestamp", "time_offset")  # s; integer fields are ns
MOST_POINTS = 2_000_000
_LONGEST = 1.0  # s, of a scan


@dataclass(frozen=True)
class PointScan:
    """The returns of one scan.

    Attributes:
        points: (n, 3) m, finite, each in the lidar's frame at its own time.
        times: (n,) s after the stamp; all 0 if the cloud has no times.
        digest: of the raw data: two scans of a working lidar differ.
    """

    points: Array
    times: Array
    digest: int

    @property
    def duration(self) -> float:
        """Time of the last return, s after the stamp."""
        return float(self.times.max(initial=0.0))


def read_cloud(message: Any) -> PointScan:
    """Return the points of a sensor_msgs/PointCloud2; those that are not finite are dropped.

    Times are read from a field ``time`` (s), as in velodyne_pointcloud, or ``t`` (integer ns), as in Ouster's driver.

    Raises:
        ValueError: fields, sizes or number of points are not allowed; the text names them.
    """
    count = message.width * message.height
    if count > MOST_POINTS:
        raise ValueError(f"points: {count} are not allowed, at most {MOST_POINTS}")
    if message.point_step < 1 or len(message.data) < count * message.point_step:
        raise ValueError(f"data: {len(message.data)} bytes are too few for {count} points of {message.point_step}")
    kind = _layout(message)
    table = np.frombuffer(message.data, kind, count)
    points = np.stack([table[axis] for axis in ("x", "y", "z")], axis=1).astype(float)
    good = np.isfinite(points).all(axis=1)
    return PointScan(points[good], _times(table)[good], zlib.crc32(message.data))


def _layout(message: Any) -> np.dtype[Any]:
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for field in message.fields:
        kind = _KINDS.get(field.datatype)
        if kind is None or field.count > 1:
            continue
        if field.offset + np.dtype(kind).itemsize > message.point_step:
            raise ValueError(f"field {field.name}: offset {field.offset} is beyond point_step {message.point_step}")
        names.append(field.name)
        formats.append(order + kind)
        offsets.append(field.offset)
    missing = [axis for axis in ("x", "y", "z") if axis not in names]
    if missing:
        raise ValueError(f"fields: {', '.join(missing)} missing among {', '.join(names) or 'none'}")
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": message.point_step})


def _times(table: NDArray[Any]) -> Array:
    for name in _TIMES:
        if name in (table.dtype.names or ()):
            times = table[name].astype(float)
            if table.dtype[name].kind in "iu":
                times *= 1e-9
            is_usable = bool(((times >= 0.0) & (times <= _LONGEST)).all())
            return times if is_usable else np.zeros(len(table))
    return np.zeros(len(table))
