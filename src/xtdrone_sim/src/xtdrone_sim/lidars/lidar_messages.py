"""Scans as ROS messages."""

from __future__ import annotations

import math

import numpy as np
from rospy import Time
from sensor_msgs.msg import LaserScan, PointCloud2, PointField

from xtdrone_sim.kernel import kernel_for_threads
from xtdrone_sim.lidars.scan_measurement import Scan, begin_us
from xtdrone_sim.vehicles.mounts.fleet_sensor import Lidar
from xtdrone_sim.vehicles.mounts.lidar_mounts import LidarMount

POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
)  # packed, as velodyne_pointcloud's PointXYZIRT
_TYPES = {"<f4": PointField.FLOAT32, "<u2": PointField.UINT16}
FIELDS = [
    PointField(name, int(POINT.fields[name][1]), _TYPES[POINT.fields[name][0].str], 1)  # type: ignore[index]
    for name in POINT.names or ()
]


@kernel_for_threads
def _fill(directions, times, rings, ranges, intensities, points):
    """Fill ``points`` (n,) ``POINT`` with those of the n rays that have a return; return their number."""
    count = 0
    for i in range(len(ranges)):
        distance = ranges[i]
        if math.isfinite(distance):
            point = points[count]
            point.x, point.y, point.z = (
                distance * directions[i, 0],
                distance * directions[i, 1],
                distance * directions[i, 2],
            )
            point.intensity, point.ring, point.time = intensities[i], rings[i], times[i]
            count += 1
    return count


def laser_scan(mount: LidarMount, frame: str, stamp: Time, scan: Scan) -> LaserScan:
    """Return a scan in one plane; stamp: the first ray's time. Limits of range as in REP 117."""
    message = LaserScan()
    message.header.stamp, message.header.frame_id = stamp, frame
    message.angle_min, message.angle_max = mount.angle_min, mount.angle_max
    message.angle_increment = (mount.angle_max - mount.angle_min) / max(mount.samples - 1, 1)
    message.time_increment = mount.duration / mount.samples
    message.scan_time = 1.0 / mount.rate
    message.range_min, message.range_max = mount.range_min, mount.range_max
    message.ranges, message.intensities = scan.ranges.tolist(), scan.intensities.tolist()
    return message


def point_cloud(frame: str, stamp: Time, scan: Scan) -> PointCloud2:
    """Return the returns of a scan as points, each in the lidar's frame at its own time.

    Args:
        frame: frame of the lidar.
        stamp: stamp of the first ray; a point's ``time`` is s after it.
        scan: scan with any number of planes; rays without a return have no point.
    """
    points = np.empty(len(scan.ranges), POINT)
    rays = scan.rays
    points = points[: _fill(rays.directions, rays.times, rays.rings, scan.ranges, scan.intensities, points)]
    message = PointCloud2(height=1, width=len(points), fields=FIELDS, point_step=POINT.itemsize, is_dense=True)
    message.header.stamp, message.header.frame_id = stamp, frame
    message.row_step, message.data = points.nbytes, points.tobytes()
    return message


def scan_message(lidar: Lidar, number: int, scan: Scan) -> LaserScan | PointCloud2:
    """Return the message of a scan."""
    stamp = Time(0, begin_us(lidar.mount, number) * 1000)
    if lidar.mount.kind == "scan":
        return laser_scan(lidar.mount, lidar.frame_id, stamp, scan)
    return point_cloud(lidar.frame_id, stamp, scan)
