"""Clouds, laser scans and depth images of sensor_msgs as arrays, and arrays as clouds."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rospy import Time
from sensor_msgs.msg import PointCloud2, PointField

Array = NDArray[np.float64]

MOST_POINTS = 2_000_000
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_TIMES = ("time", "t", "timestamp", "time_offset")  # s; integer fields are ns
_DEPTHS = {"32FC1": ("f4", 1.0), "16UC1": ("u2", 1e-3)}  # type and unit, m, of depth images (REP 118)
_MOST_RAYS = 100_000
_LONGEST = 1.0  # s, of a scan


class ScanError(ValueError):
    """A cloud, scan or image that cannot be read; the message names the field, its value and what is allowed."""


@dataclass(frozen=True)
class PointScan:
    """The returns of one scan.

    Attributes:
        points: (n, 3) m, finite, each in the lidar's frame at its own time.
        times: (n,) s after the stamp; all 0 if the cloud has no times.
        digest: Checksum of the raw data: two scans of a working lidar differ.
    """

    points: Array
    times: Array
    digest: int

    @property
    def duration(self) -> float:
        """Time of the last return, s after the stamp."""
        return float(self.times.max(initial=0.0))


def points_of(message: Any) -> NDArray[np.void]:
    """Return the points of a sensor_msgs/PointCloud2, (n,), as records of its fields that are single numbers.

    Raises:
        ScanError: The fields, sizes or number of points are not allowed.
    """
    count, step = message.width * message.height, message.point_step
    if count > MOST_POINTS:
        raise ScanError(f"points: {count} are not allowed, at most {MOST_POINTS}")
    if step < 1 or len(message.data) < count * step:
        raise ScanError(f"data: {len(message.data)} bytes are too few for {count} points of {step}")
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.datatype in _KINDS and field.count <= 1]
    formats = [order + _KINDS[field.datatype] for field in fields]
    for field, code in zip(fields, formats, strict=True):
        if field.offset + np.dtype(code).itemsize > step:
            raise ScanError(f"field {field.name}: offset {field.offset} is beyond point_step {step}")
    names = [field.name for field in fields]
    missing = [axis for axis in "xyz" if axis not in names]
    if missing:
        raise ScanError(f"fields: {', '.join(missing)} missing among {', '.join(names) or 'none'}")
    offsets = [field.offset for field in fields]
    kind = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    return np.frombuffer(message.data, kind, count)


def read_cloud(message: Any) -> PointScan:
    """Return the points of a sensor_msgs/PointCloud2; those that are not finite are dropped.

    Times are read from a field ``time`` (s), as in velodyne_pointcloud, or ``t`` (integer ns), as in Ouster's driver.

    Raises:
        ScanError: See ``points_of``.
    """
    table = points_of(message)
    points = np.stack([table[axis] for axis in "xyz"], axis=1).astype(float)
    good = np.isfinite(points).all(axis=1)
    return PointScan(points[good], _read_times(table)[good], zlib.crc32(message.data))


def _read_times(table: NDArray[np.void]) -> Array:
    for name in _TIMES:
        if name in (table.dtype.names or ()):
            times = table[name].astype(float)
            if table.dtype[name].kind in "iu":
                times *= 1e-9
            is_usable = bool(((times >= 0.0) & (times <= _LONGEST)).all())
            return times if is_usable else np.zeros(len(table))
    return np.zeros(len(table))


def cloud_message(points: Array, stamp: Time, frame: str) -> PointCloud2:
    """Return points (n, 3) m as a cloud of float32."""
    data = np.ascontiguousarray(points, "<f4")
    fields = [PointField(axis, 4 * k, PointField.FLOAT32, 1) for k, axis in enumerate("xyz")]
    message = PointCloud2(height=1, width=len(data), fields=fields, point_step=12, is_dense=True)
    message.header.stamp, message.header.frame_id = stamp, frame
    message.row_step, message.data = data.nbytes, data.tobytes()
    return message


class ReadScan(NamedTuple):
    """The returns of a laser scan: (n, 2) m in its plane, and times (n,) s after the stamp; the scan's duration."""

    points: Array
    times: Array
    duration: float


def read_scan(message: Any) -> ReadScan:
    """Return the valid returns of a sensor_msgs/LaserScan; other ranges are infinite or out of range (REP 117).

    Raises:
        ScanError: The angles, times or number of rays are not allowed.
    """
    ranges = np.asarray(message.ranges, float)
    if not 1 < len(ranges) <= _MOST_RAYS:
        raise ScanError(f"ranges: {len(ranges)} are not allowed, 2 to {_MOST_RAYS}")
    duration = message.time_increment * (len(ranges) - 1)
    if not (np.isfinite([message.angle_min, message.angle_increment]).all() and 0.0 <= duration <= _LONGEST):
        raise ScanError(
            f"angle_min {message.angle_min}, angle_increment {message.angle_increment}, time_increment "
            f"{message.time_increment}: not finite, or longer than {_LONGEST:g} s"
        )
    index = np.flatnonzero(np.isfinite(ranges) & (ranges >= message.range_min) & (ranges <= message.range_max))
    angle = message.angle_min + message.angle_increment * index
    points = ranges[index, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return ReadScan(points, message.time_increment * index, float(duration))


def image_rows(message: Any, size: int) -> NDArray[np.uint8]:
    """Return the rows of a sensor_msgs/Image without padding, (height, width * size), from pixels of ``size`` bytes.

    Raises:
        ScanError: The size of the image does not match its data.
    """
    width, height, step = message.width, message.height, message.step
    if not width or not height or step < size * width or len(message.data) != step * height:
        raise ScanError(f"{width} x {height} px in rows of {step} bytes, but {len(message.data)} bytes")
    return np.frombuffer(message.data, np.uint8).reshape(height, step)[:, : size * width]


def depths_of(message: Any, kind: type[np.floating[Any]] = np.float64) -> NDArray[Any]:
    """Return the depths of an image (REP 118), (height, width) m along the optical axis, NaN where unknown.

    Raises:
        ScanError: The encoding is not that of a depth image, or the size does not match the data.
    """
    if message.encoding not in _DEPTHS:
        raise ScanError(f"encoding: {message.encoding!r} is not allowed, {', '.join(_DEPTHS)}")
    code, unit = _DEPTHS[message.encoding]
    item = np.dtype((">" if message.is_bigendian else "<") + code)
    depths = np.ascontiguousarray(image_rows(message, item.itemsize)).view(item).astype(kind) * kind(unit)
    depths[~(depths > 0.0)] = np.nan
    return depths
